"""Results, pictures and the report of a comparison."""
