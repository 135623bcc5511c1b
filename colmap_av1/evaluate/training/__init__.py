"""Trainers of 3D Gaussians on models."""
