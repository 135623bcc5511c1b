"""Implausible focal lengths are reported."""

from __future__ import annotations

import pycolmap
import pytest

from colmap_av1.geometry.cameras import focal_length_warning


def camera(focal_length: float, model: str = "SIMPLE_RADIAL") -> pycolmap.Camera:
    return pycolmap.Camera.create_from_model_id(
        1, getattr(pycolmap.CameraModelId, model), focal_length, 500, 375
    )


@pytest.mark.parametrize("focal_length", [140.0, 5853.0])
def test_implausible_focal_length_is_reported(focal_length: float) -> None:
    warning = focal_length_warning([camera(450.0), camera(focal_length)])
    assert warning is not None
    assert f"{focal_length:.0f} px" in warning


def test_plausible_focal_lengths_are_not_reported() -> None:
    fisheye = camera(120.0, "OPENCV_FISHEYE")
    assert focal_length_warning([camera(160.0), camera(2400.0), fisheye]) is None
