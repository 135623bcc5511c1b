"""The rows that `map` and `check --model` print."""

from __future__ import annotations

import numpy as np

from colmap_av1.check.model import ModelCheck
from colmap_av1.check.model_figures import ModelFigures
from colmap_av1.cli.reports import model_rows
from colmap_av1.poses.seams import Seams

NONE = np.empty(0, np.int64)


def rows(shortest: float, longest: float) -> dict[str, str]:
    figures = ModelFigures(
        num_registered=42,
        num_points=9000,
        mean_track_length=5.0,
        coverage=0.9,
        mean_error=0.5,
        median_error=0.4,
        focal_length=(shortest + longest) / 2,
        focal_lengths=(shortest, longest),
    )
    return dict(model_rows(ModelCheck(figures, Seams((), NONE, NONE, NONE, NONE), None, None)))


def test_focal_lengths_are_printed_as_a_range() -> None:
    assert rows(319.2, 475.1)["focal lengths"] == "319.20 to 475.10 px"
    assert rows(319.2, 319.2)["focal length"] == "319.20 px"
