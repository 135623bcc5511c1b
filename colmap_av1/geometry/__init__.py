"""Cameras, COLMAP models on disk, triangulation, resection, undistortion and alignment."""
