"""What a comparison shows: results, pictures, the report."""
