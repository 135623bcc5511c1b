"""Features of pictures: SIFT, those of overlays among them, and images that look alike by them."""
