"""The front-ends that are compared, the images they share, and the mapper on their databases."""
