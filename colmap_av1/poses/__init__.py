"""Joint estimation of all poses: key images, mapper, resection, bundle adjustment."""
