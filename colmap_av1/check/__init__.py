"""Diagnosis of COLMAP databases and models."""
