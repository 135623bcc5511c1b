"""COLMAP's database: opening, checking, reading and writing it."""
