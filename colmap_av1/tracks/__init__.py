"""Chain motion into tracks, correct them on pictures, and select some of them."""
