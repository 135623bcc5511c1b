"""The images: choosing frames, naming, reading and writing files, masks and photos."""
