"""The joint estimate of all poses: key images, mapper, resection, adjustment."""
