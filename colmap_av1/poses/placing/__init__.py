"""Places a model in world coordinates: scale, up direction and origin."""
