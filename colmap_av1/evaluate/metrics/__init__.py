"""Metrics of poses, clouds and renderings."""
