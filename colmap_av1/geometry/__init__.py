"""Cameras, COLMAP models on disk, triangulation, resection, undistortion, alignment."""
