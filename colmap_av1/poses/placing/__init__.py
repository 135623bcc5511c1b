"""Where a model lies in the world: scale, up, origin."""
