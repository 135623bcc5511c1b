"""What is compared: front-ends, the images they share, the mapper after them."""
