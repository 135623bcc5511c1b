"""Dynamic objects: finding them, and excluding them from the tracks."""
