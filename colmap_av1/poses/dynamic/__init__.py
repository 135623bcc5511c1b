"""What moves in the scene on its own, and leaving it out."""
