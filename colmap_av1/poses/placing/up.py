"""The up direction of a model, from gravity, vertical lines or how the camera was held."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from typing import TypeVar

import cv2
import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap
from numpy.typing import NDArray

from colmap_av1.util.arrays import Bools, Floats
from colmap_av1.util.spread import evenly_spread

_Item = TypeVar("_Item")

# Weight of the mean up direction of the images compared with the requirement that their x axes are
# horizontal. It is small, because cameras are pitched more than they are rolled.
_PITCH_WEIGHT = 0.005
# A picture is stored sideways if its up direction is this far from the usual one, unless that is
# true of more than this share of the pictures: those of a camera that looks down point anywhere.
_TURNED = np.deg2rad(60)
_MOST_TURNED = 0.3
# Sine of the largest angle between a vertical line and the approximate up direction, and the
# smallest number of lines.
_LARGEST_LEAN = np.sin(np.deg2rad(20))
_LEAST_LINES = 20
# Sine of the angle to the vertical that is the scale of the Cauchy loss.
_LINE_SCALE = np.sin(np.deg2rad(1))
_ITERATIONS = 20
# Length of the shortest line, as a share of the picture's shorter side.
_SHORTEST_LINE = 0.06
# Largest shorter side, in pixels, of a picture in which lines are detected.
_LINE_PICTURE = 720
_NUM_PICTURES = 12
# With a larger median scatter in degrees, gravity is not constant and is ignored.
_LARGEST_SCATTER = 10.0


def up_of_cameras(cam_from_world: Floats) -> Floats:
    """Up direction (unit vector) of cameras [n, 3, 4] most of which are rolled little.

    It is perpendicular to the x axes of the cameras. If these are parallel, it is the perpendicular
    direction that is closest to the mean -y axis. A minority of pictures may be stored sideways or
    upside down, as photos of phones often are.
    """
    is_turned = _is_turned(cam_from_world)
    if is_turned.mean() <= _MOST_TURNED:
        cam_from_world = cam_from_world[~is_turned]
    across, down = cam_from_world[:, 0, :3], cam_from_world[:, 1, :3]
    mean = -down.mean(axis=0)
    mean /= max(float(np.linalg.norm(mean)), 1e-12)
    rolled = across.T @ across / len(across)
    pitched = _PITCH_WEIGHT * (np.eye(3) - np.outer(mean, mean))
    found = np.linalg.eigh(rolled + pitched)[1][:, 0]
    return np.asarray(found if found @ mean >= 0 else -found)


def _is_turned(cam_from_world: Floats) -> Bools:
    """Which cameras' -y axes are far from the usual one."""
    up = -cam_from_world[:, 1, :3]
    usual = up.mean(axis=0)
    for _ in range(_ITERATIONS):  # Weiszfeld's iteration for the geometric median
        distance = np.maximum(np.linalg.norm(up - usual, axis=1), 1e-6)
        usual = (up / distance[:, None]).sum(axis=0) / (1 / distance).sum()
    usual /= max(float(np.linalg.norm(usual)), 1e-12)
    return np.asarray(up @ usual < np.cos(_TURNED))


def up_of_gravity(cam_from_world: Floats, gravity: Floats) -> tuple[Floats, float] | None:
    """Up direction from gravity, measured in camera axes of unknown order and signs.

    Manufacturers define these axes differently, and rotate them with the picture. All 48 orders and
    signs are tried. The one is chosen with which gravity is constant in the world and points down
    in the images.

    Args:
        cam_from_world: float64 [n, 3, 4].
        gravity: float64 [n, 3] vectors; NaN where unknown.

    Returns:
        The unit vector, and the median angle in degrees between it and single images; None if
        gravity is unknown, or is not constant with any axes.
    """
    known = np.isfinite(gravity).all(axis=1)
    if not known.any():
        return None
    rotation, gravity = cam_from_world[known, :, :3], gravity[known]
    gravity = gravity / np.linalg.norm(gravity, axis=1, keepdims=True)
    best: tuple[float, Floats, float] | None = None
    for order in itertools.permutations(range(3)):
        for signs in itertools.product((1.0, -1.0), repeat=3):
            seen = gravity[:, order] * signs
            world = np.einsum("nij,ni->nj", rotation, seen)
            mean = world.mean(axis=0)
            length = max(float(np.linalg.norm(mean)), 1e-12)
            scatter = 1 - length
            # Down in the images is +y. This decides only between axes of similar scatter.
            score = scatter + 0.02 * (1 - float(np.mean(seen[:, 1])))
            if best is None or score < best[0]:
                spread = np.rad2deg(np.arccos(np.clip(world @ mean / length, -1, 1)))
                best = score, -mean / length, float(np.median(spread))
    assert best is not None
    return (best[1], best[2]) if best[2] <= _LARGEST_SCATTER else None


def vertical_lines(
    picture: NDArray[np.uint8], camera: pycolmap.Camera, pose: Floats, up: Floats
) -> Floats:
    """Planes through the camera centre and lines in its picture that may be vertical.

    Args:
        picture: uint8 [height, width, 3] BGR picture.
        camera: its camera.
        pose: float64 [3, 4] cam_from_world.
        up: approximate up direction (unit vector).

    Returns:
        float64 [n, 3] unit normals of the planes in the world. They are perpendicular to the up
        direction if the lines are vertical.
    """
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    shrink = min(1.0, _LINE_PICTURE / min(grey.shape))
    small = cv2.resize(grey, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
    found = cv2.createLineSegmentDetector().detect(small)[0]
    if found is None:
        return np.empty((0, 3))
    ends = found.reshape(-1, 2, 2).astype(np.float64)
    long = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) >= _SHORTEST_LINE * min(small.shape)
    # The centre of the first pixel is (0, 0) in OpenCV and (0.5, 0.5) in COLMAP.
    pixels = (ends[long].reshape(-1, 2) + 0.5) / shrink
    rays = np.column_stack([camera.cam_from_img(pixels), np.ones(len(pixels))])
    rays = rays.reshape(-1, 2, 3) @ pose[:, :3]
    normals = np.cross(rays[:, 0], rays[:, 1])
    length = np.linalg.norm(normals, axis=1)
    normals = normals[length > 0] / length[length > 0, None]
    return np.asarray(normals[np.abs(normals @ up) < _LARGEST_LEAN])


def pictures_for_lines(items: Sequence[_Item]) -> list[_Item]:
    """Choose the evenly spread items in whose pictures lines are detected."""
    return [items[i] for i in evenly_spread(len(items), _NUM_PICTURES, rounded=True)]


def up_of_lines(normals: Iterable[Floats], up: Floats) -> Floats | None:
    """Direction of most lines, by iteratively reweighted least squares with the Cauchy loss.

    Args:
        normals: results of `vertical_lines` for each picture.
        up: approximate up direction (unit vector).

    Returns:
        The unit vector; None if there are few lines, or few inliers.
    """
    planes = np.concatenate([np.empty((0, 3)), *normals])
    if len(planes) < _LEAST_LINES:
        return None
    found, scale = up, float(_LARGEST_LEAN)
    for _ in range(_ITERATIONS):
        weight = 1 / (1 + (planes @ found / scale) ** 2)
        turned = np.linalg.eigh((weight[:, None] * planes).T @ planes)[1][:, 0]
        found = turned if turned @ found >= 0 else -turned
        scale = max(scale / 1.5, float(_LINE_SCALE))
    agree = np.abs(planes @ found) < 2 * _LINE_SCALE
    if agree.sum() < _LEAST_LINES or found @ up < np.cos(np.arcsin(_LARGEST_LEAN)):
        return None
    return np.asarray(found)


def rotation_to_up(up: Floats) -> Floats:
    """The smallest rotation [3, 3] that rotates a unit vector to +z."""
    target = np.array([0.0, 0.0, 1.0])
    axis = np.cross(up, target)
    cosine = float(up @ target)
    if cosine < -1 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    x, y, z = axis
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.asarray(np.eye(3) + skew + skew @ skew / (1 + cosine))
