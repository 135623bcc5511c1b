"""Image pairs, their matches and two-view geometries, the focal length."""
