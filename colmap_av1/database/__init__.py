"""COLMAP's database and what other programs keep in its place."""
