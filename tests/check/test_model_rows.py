"""The rows that `map` and `check --model` print."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from colmap_av1.check.model import ModelCheck, check_model
from colmap_av1.check.model_figures import ModelFigures, model_figures
from colmap_av1.cli.reports import model_rows
from colmap_av1.errors import ModelError
from colmap_av1.geometry.colmap_model import read_model
from colmap_av1.poses.seams import Seams
from colmap_av1.reconstruct import ReconstructReport

NONE = np.empty(0, np.int64)


def check(shortest: float, longest: float, expected_error: float | None = None) -> ModelCheck:
    figures = ModelFigures(
        num_registered=42,
        num_points=9000,
        mean_track_length=5.0,
        coverage=0.9,
        mean_error=0.5,
        median_error=0.4,
        focal_lengths=(shortest, longest),
    )
    return ModelCheck(figures, Seams((), NONE, NONE, NONE, NONE), expected_error, None, None)


def rows(shortest: float, longest: float) -> dict[str, str]:
    return dict(model_rows(check(shortest, longest)))


def test_uncertain_positions_are_reported() -> None:
    certain, uncertain = check(300, 300, 0.0002), check(300, 300, 0.0042)
    assert "0.020%" in dict(model_rows(certain))["camera positions"]
    assert certain.warnings == ()
    (warning,) = uncertain.warnings
    assert "0.4%" in warning


def test_focal_lengths_are_printed_as_a_range() -> None:
    assert rows(319.2, 475.1)["focal lengths"] == "319.20 to 475.10 px"
    assert rows(319.2, 319.2)["focal length"] == "319.20 px"


def test_figures_ignore_cameras_without_images(made: ReconstructReport) -> None:
    model = read_model(made.output / "sparse" / "0")
    before = model_figures(model)
    model.add_camera_with_trivial_rig(
        pycolmap.Camera(
            camera_id=9, model="PINHOLE", width=64, height=48, params=[5000.0, 5000.0, 32.0, 24.0]
        )
    )
    assert model_figures(model).focal_lengths == before.focal_lengths


def test_model_without_poses_is_an_error() -> None:
    with pytest.raises(ModelError, match="no registered image"):
        check_model(pycolmap.Reconstruction())
