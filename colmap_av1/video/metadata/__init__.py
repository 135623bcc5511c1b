"""Metadata of a video: GPS positions, gravity, focal length and spherical projection."""
