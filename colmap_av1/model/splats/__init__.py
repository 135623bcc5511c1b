"""Points and Gaussians that trainers of Gaussian splats start well from."""
