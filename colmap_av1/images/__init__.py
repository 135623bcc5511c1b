"""Which frames become images, under which names, and their camera."""
