"""Metrics of tracks, poses, clouds and renderings."""
