from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from colmap_av1.geometry.cameras import make_camera
from colmap_av1.matching.initial_pair_trial import try_initial_pair
from colmap_av1.matching.mapper_limits import DEFAULT_LIMITS, SMALL_ANGLES
from colmap_av1.options import CameraOptions

CAMERA = make_camera(
    CameraOptions(camera_model="SIMPLE_RADIAL", camera_params="576,320,240,0"), 640, 480
)


def two_views(
    spread: float, depth: float, angle: float
) -> tuple[list[NDArray[np.float32]], NDArray[np.float64]]:
    """Two images of 200 points within `spread` of the axis and `depth` of 1, and their pose."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-spread, spread, (200, 2))
    points = np.c_[x, np.ones(200)] * (1 + rng.uniform(-depth, depth, 200))[:, None]
    turn = Rotation.from_euler("y", angle, degrees=True).as_matrix()
    seen = points, points @ turn.T + [0, 0, 1] - turn[:, 2]
    xy = [CAMERA.img_from_cam(own) + rng.normal(0, 0.3, (200, 2)) for own in seen]
    return [own.astype(np.float32) for own in xy], turn


def test_pose_is_that_of_the_images() -> None:
    xy, turn = two_views(0.5, 0.3, 20.0)
    found = try_initial_pair(xy, CAMERA, DEFAULT_LIMITS)
    assert found is not None
    assert not found.diverged
    assert found.cam2_from_cam1[:, :3] == pytest.approx(turn, abs=0.02)


def test_intrinsics_diverge_if_the_points_fill_a_small_part_of_the_image() -> None:
    found = try_initial_pair(two_views(0.1, 0.02, 20.0)[0], CAMERA, DEFAULT_LIMITS)
    assert found is not None
    assert found.diverged


def test_no_model_begins_below_the_limits() -> None:
    xy, _ = two_views(0.5, 0.3, 10.0)
    assert try_initial_pair(xy, CAMERA, DEFAULT_LIMITS) is None
    assert try_initial_pair(xy, CAMERA, SMALL_ANGLES) is not None


def test_log_stays_silent(capfd: pytest.CaptureFixture[str]) -> None:
    try_initial_pair(two_views(0.5, 0.3, 20.0)[0], CAMERA, DEFAULT_LIMITS)
    assert capfd.readouterr() == ("", "")
