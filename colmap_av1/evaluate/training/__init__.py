"""Training 3D Gaussians on models, with gsplat or an external trainer."""
