"""Initial intrinsics, and focal lengths that are long or implausible."""

from __future__ import annotations

import pycolmap
import pytest

from colmap_av1.errors import OptionError
from colmap_av1.geometry.cameras import (
    focal_length_warning,
    has_long_focal_length,
    make_camera,
    off_centre_warning,
    with_initial_intrinsics,
)
from colmap_av1.options import CameraOptions


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


def test_long_focal_lengths_are_those_of_narrow_fields_of_view() -> None:
    assert has_long_focal_length(camera(650.0))
    assert not has_long_focal_length(camera(550.0))


@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "OPENCV", "OPENCV_FISHEYE"])
def test_initial_intrinsics_are_those_of_a_new_camera(model: str) -> None:
    new = make_camera(CameraOptions(camera_model=model), 500, 375)
    refined = camera(900.0, model)
    params = refined.params
    params[refined.extra_params_idxs()] = 0.1
    refined.params = params.tolist()
    assert with_initial_intrinsics(refined).params.tolist() == pytest.approx(new.params.tolist())
    assert refined.mean_focal_length() == 900.0


def test_principal_point_of_another_picture_size_is_doubtful() -> None:
    def warning(params: str, width: int, height: int) -> str | None:
        return off_centre_warning(make_camera(CameraOptions("PINHOLE", params), width, height))

    assert warning("255,255,180,320", 360, 640) is None
    assert warning("255,255,320,180", 360, 640) is not None
    with pytest.raises(OptionError):
        warning("510,510,360,640", 360, 640)
