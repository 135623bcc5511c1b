"""Image corners, located in every image that sees them."""
