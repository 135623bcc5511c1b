"""Compute figures of a COLMAP model: images, points, errors, focal length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap

from colmap_av1.errors import ModelError
from colmap_av1.geometry.coverage import coverage_of_model
from colmap_av1.geometry.posed_model import posed_model


@dataclass(frozen=True)
class ModelFigures:
    """Figures of a model.

    Attributes:
        num_registered: number of registered images.
        num_points: number of 3D points.
        mean_track_length: mean number of observations of a point.
        coverage: share of the images' cells of 16x16 pixels into which visible points project.
        mean_error: mean reprojection error of the points in pixels, as in COLMAP.
        median_error: median reprojection error of the points in pixels.
        focal_lengths: shortest and longest focal length of the cameras in pixels.
    """

    num_registered: int
    num_points: int
    mean_track_length: float
    coverage: float
    mean_error: float
    median_error: float
    focal_lengths: tuple[float, float]


def model_figures(model: pycolmap.Reconstruction) -> ModelFigures:
    """Compute the figures of a model.

    Raises:
        ModelError: the model has no registered images.
    """
    posed = posed_model(model)
    if not posed.images:
        raise ModelError("the model has no registered image")
    errors = np.array([p.error for p in model.points3D.values()], dtype=np.float64)
    known = errors[errors >= 0]
    focal_lengths = [camera.mean_focal_length() for camera in posed.cameras.values()]
    return ModelFigures(
        num_registered=model.num_reg_images(),
        num_points=len(errors),
        mean_track_length=model.compute_mean_track_length(),
        coverage=coverage_of_model(model),
        mean_error=float(known.mean()) if len(known) else float("nan"),
        median_error=float(np.median(known)) if len(known) else float("nan"),
        focal_lengths=(min(focal_lengths), max(focal_lengths)),
    )
