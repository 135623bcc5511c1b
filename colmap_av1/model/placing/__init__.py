"""Where a model lies in the world: its scale, what is up, and its coordinates."""
