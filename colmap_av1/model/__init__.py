"""Poses by COLMAP's mappers, points triangulated on them, models for trainers."""
