"""Motion of every coded frame, read from the AV1 bitstream."""
