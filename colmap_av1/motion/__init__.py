"""Motion of every coded frame, read from the bitstream."""
