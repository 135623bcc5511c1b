"""COLMAP's database, and the files that other programs use instead."""
