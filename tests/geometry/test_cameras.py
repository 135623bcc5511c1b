"""Initial intrinsics, and focal lengths that are long or implausible."""

from __future__ import annotations

import numpy as np
import pycolmap
import pytest

from colmap_av1.geometry.cameras import (
    focal_length_warning,
    has_long_focal_length,
    make_camera,
    with_initial_intrinsics,
    with_one_distortion_parameter,
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


def test_second_distortion_parameter_of_a_phone_is_omitted() -> None:
    lens = pycolmap.Camera(
        camera_id=3, model="RADIAL", width=450, height=800, params=[711, 225, 400, 0.084, -0.143]
    )
    lens.has_prior_focal_length = True
    simple = with_one_distortion_parameter(lens)
    assert (simple.model_name, simple.camera_id) == ("SIMPLE_RADIAL", 3)
    assert simple.has_prior_focal_length
    xy = np.random.default_rng(0).uniform((0, 0), (450, 800), (1000, 2))
    moved = simple.img_from_cam(np.c_[lens.cam_from_img(xy), np.ones(1000)]) - xy
    assert np.sqrt((moved**2).sum(axis=1).mean()) < 0.5


def test_wide_lens_keeps_two_distortion_parameters() -> None:
    lens = pycolmap.Camera(
        camera_id=3, model="RADIAL", width=450, height=800, params=[317, 225, 400, 0.011, -0.015]
    )
    assert with_one_distortion_parameter(lens) is lens
