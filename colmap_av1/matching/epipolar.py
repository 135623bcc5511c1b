"""Epipolar errors of matches, given a matrix or the poses of two images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import relative_pose
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.util.arrays import Bools, Floats

# Keeps a division by a squared gradient of 0 finite.
SMALLEST_GRADIENT = np.finfo(np.float64).tiny


def epipolar_terms(F: Floats, xa: Floats, xb: Floats) -> tuple[Floats, Floats]:
    """The algebraic epipolar error of matches and its squared gradient.

    Args:
        F: float64 [3, 3] fundamental or essential matrix.
        xa: float64 [2, n] positions in the first image, in the coordinates of the matrix.
        xb: float64 [2, n] positions in the second image.

    Returns:
        The algebraic errors and the squared lengths of their gradients, float64 [n] each.
    """
    lines_b = F[:, :2] @ xa + F[:, 2:]
    lines_a = F.T[:2, :2] @ xb + F.T[:2, 2:]
    algebraic = xb[0] * lines_b[0] + xb[1] * lines_b[1] + lines_b[2]
    gradient = lines_b[0] ** 2 + lines_b[1] ** 2 + lines_a[0] ** 2 + lines_a[1] ** 2
    return algebraic, gradient


def sampson_error(F: Floats, xa: Floats, xb: Floats) -> Floats:
    """Sampson error of matches (Hartley and Zisserman, eq. 11.9).

    Args:
        F: see `epipolar_terms`, as the next two.
        xa: positions in the first image.
        xb: positions in the second image.

    Returns:
        float64 [n] in the units of the positions.
    """
    algebraic, gradient = epipolar_terms(F, xa, xb)
    return np.asarray(np.abs(algebraic) / np.sqrt(np.maximum(gradient, SMALLEST_GRADIENT)))


def epipolar_inliers(F: Floats, xa: Floats, xb: Floats, max_error: float) -> Bools:
    """Matches whose Sampson error is within a limit.

    Args:
        F: see `epipolar_terms`, as the next two.
        xa: positions in the first image.
        xb: positions in the second image.
        max_error: largest Sampson error, in the units of the positions.

    Returns:
        bool [n].
    """
    algebraic, gradient = epipolar_terms(F, xa, xb)
    return np.asarray(algebraic**2 <= max_error**2 * gradient)


def essential_of_poses(a: Floats, b: Floats) -> Floats:
    """The essential matrix of two images with known poses.

    Args:
        a: float64 [3, 4] pose of the first image, x_cam = R x_world + t.
        b: float64 [3, 4] pose of the second image.

    Returns:
        float64 [3, 3] in normalised coordinates.
    """
    relative = relative_pose(a, b)
    x, y, z = relative[:, 3]
    return np.asarray(np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]]) @ relative[:, :3])


def error_by_poses(
    poses: Sequence[Floats], cameras: Sequence[pycolmap.Camera], rays: Sequence[Floats]
) -> Floats:
    """The Sampson error of matches between two images with known poses.

    Args:
        poses: [3, 4] cam_from_world of both images.
        cameras: their cameras.
        rays: [2, n] positions of the matches in both images, (x / z, y / z).

    Returns:
        float64 [m] errors in pixels, without those of matches at distorted positions that have no
        ray.
    """
    focal = np.mean([camera.mean_focal_length() for camera in cameras])
    error = float(focal) * sampson_error(essential_of_poses(*poses), *rays)
    return np.asarray(error[np.isfinite(error)])


def error_of_pixels(
    views: Sequence[PosedCamera], xy: Sequence[NDArray[np.floating[Any]]]
) -> Floats:
    """The Sampson error of matches in pixels of two images, see `error_by_poses`.

    Args:
        views: both images.
        xy: [n, 2] positions of the matches in both images, in pixels.

    Returns:
        float64 [m] errors in pixels, without those of matches that have no ray.
    """
    rays = [
        np.asarray(view.camera.cam_from_img(own.astype(np.float64))).T
        for view, own in zip(views, xy, strict=True)
    ]
    return error_by_poses(
        [view.cam_from_world for view in views], [view.camera for view in views], rays
    )
