"""The compared front-ends, their common images, and mapping of their databases."""
