"""What runs in the process that maps or adjusts."""
