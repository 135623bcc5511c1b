"""SIFT features, the removal of overlays from them, and image retrieval."""
