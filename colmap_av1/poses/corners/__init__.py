"""Corners of the pictures, found again in every image that sees them."""
