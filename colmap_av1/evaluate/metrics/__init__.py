"""What is measured: tracks, poses, clouds, renderings."""
