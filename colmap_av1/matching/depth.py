"""Test whether matches determine depth, or the camera only turns or zooms."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.cameras import assumes_focal_length
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.util.arrays import Floats

# Focal lengths to try, in units of the longer image side. With longer ones, a rotation looks like
# a translation along a plane.
_FOCAL_LENGTHS = np.geomspace(0.4, 1.2, 14)
# Number of pairs to test (one in each part of the sequence), and matches used and needed per pair.
_NUM_PAIRS = 40
_NUM_MATCHES = 100
LEAST_MATCHES = 30
# A pair has parallax if this quantile of its residuals exceeds this length, in units of the longer
# image side (0.4 to 0.5 degrees).
_QUANTILE, _LEAST_PARALLAX = 0.75, 8.5e-3
# About this share of the pairs of a hand-held zoom seems to have parallax, because zooming changes
# the lens distortion, and less if the focal length is known. A fifth of the pairs has parallax if
# somebody films a room from a few places, more than half on a flight over a plain, and nearly all
# on drives and walks, except in fast turns. Depth is observable if significantly more pairs have
# parallax: more by this number of standard deviations.
_ZOOM_SHARE, _KNOWN_SHARE, _SIGNIFICANT = 0.1, 0.04, 2.0
# Depth is unreliable if a smaller share of the pairs has parallax.
_RELIABLE_SHARE = 0.4
# Number of Gauss-Newton steps, and the scale of the robust loss in units of the longer image side.
# The scale is halved after each step, down to the last value.
_NUM_STEPS = 10
_FIRST_LOSS, _LAST_LOSS = 0.032, 1e-3
# Limits of the change in one step (radians and logarithm of the zoom) and of the zoom's logarithm.
_LARGEST_STEP, _LARGEST_ZOOM = 0.3, 2.0
# Smallest depth of a rotated ray, to divide by.
_MIN_DEPTH = 1e-3


@dataclass(frozen=True)
class DepthEvidence:
    """Number of image pairs that show parallax.

    Attributes:
        num_pairs: pairs that were tested, the ones with the widest motion.
        num_with_parallax: pairs whose motion no rotation and zoom of the camera explains.
        is_focal_length_known: whether all images have a known focal length.
    """

    num_pairs: int
    num_with_parallax: int
    is_focal_length_known: bool

    @property
    def is_observable(self) -> bool:
        """Whether the matches determine depth at all; True if no pair was tested."""
        share = _KNOWN_SHARE if self.is_focal_length_known else _ZOOM_SHARE
        expected = share * self.num_pairs
        deviation = math.sqrt(expected * (1 - share))
        return self.num_with_parallax >= expected + _SIGNIFICANT * deviation

    @property
    def warning(self) -> str | None:
        """A warning about missing or rare parallax; None if there is enough."""
        if not self.is_observable:
            return (
                "depth is not observable: the camera stands still, or only turns or zooms: film "
                "while moving sideways, or give a longer part of the video"
            )
        if self.num_with_parallax < _RELIABLE_SHARE * self.num_pairs:
            return (
                "in most parts of the images the camera only turns or zooms: the depth of points "
                "may be unreliable there: film while moving sideways"
            )
        return None


def motion_spread(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """Spread of the displacements of matches [n, 2], in pixels."""
    motion = b.astype(np.float64) - a
    return float(np.hypot(*np.subtract(*np.quantile(motion, (0.9, 0.1), axis=0))))


def depth_evidence(
    keypoints: Sequence[NDArray[np.float32]],
    pairs: NDArray[np.integer],
    spread: Floats,
    matches: Callable[[int], NDArray[np.integer]],
    cameras: Sequence[pycolmap.Camera | None],
) -> DepthEvidence:
    """Look for parallax in the image pairs with the widest motion.

    If the camera only turns and zooms, K2 R K1^-1 maps one image to the other at any depth (Hartley
    and Zisserman, 8.4.2). This homography is fitted to each pair for a range of focal lengths of
    the first image, because a zoom makes an estimated focal length meaningless. A plane seen by a
    camera that moves sideways fits it only with focal lengths beyond this range.

    Args:
        keypoints: float32 [n, 2] of each image, in pixels, first pixel's centre at (0.5, 0.5).
        pairs: [m, 2] indices of images.
        spread: float64 [m] the spread of each pair's motion, see `motion_spread`.
        matches: returns the verified matches of a pair, [n, 2] indices of keypoints.
        cameras: the camera of each image, used to undistort keypoints. Pairs with an image that
            has no camera are skipped.
    """
    rng = np.random.default_rng(0)
    parallax = []
    part = pairs[:, 0] * _NUM_PAIRS // max(len(keypoints), 1)
    for own in (np.flatnonzero(part == number) for number in np.unique(part)):
        pair = int(own[np.argmax(np.nan_to_num(spread[own]))])
        rows = rng.permutation(matches(pair))[:_NUM_MATCHES]
        ends = [
            _centred(keypoints[image][rows[:, end]], camera)
            for end, image in enumerate(pairs[pair].tolist())
            if (camera := cameras[image]) is not None
        ]
        if len(ends) < 2:
            continue
        is_known = np.isfinite(np.hstack(ends)).all(axis=1)
        if np.count_nonzero(is_known) < LEAST_MATCHES:
            continue
        residuals = _turn_and_zoom_residuals(*(end[is_known] for end in ends))
        parallax.append(float(np.quantile(residuals, _QUANTILE, axis=1).min()))
    return DepthEvidence(
        len(parallax),
        int(np.sum(np.array(parallax) > _LEAST_PARALLAX)),
        not assumes_focal_length(camera for camera in cameras if camera is not None),
    )


def depth_of_images(matched: MatchedImages, cameras: Sequence[pycolmap.Camera]) -> DepthEvidence:
    """Look for parallax in matched images, see `depth_evidence`.

    Args:
        matched: the images.
        cameras: the camera of each image.
    """
    xy = [own.xy for own in matched.keypoints]
    inliers = [geometry.inlier_matches for geometry in matched.geometries]
    spread = [
        motion_spread(xy[i][rows[:, 0]], xy[j][rows[:, 1]]) if len(rows) >= LEAST_MATCHES else 0.0
        for (i, j), rows in zip(matched.pairs.tolist(), inliers, strict=True)
    ]
    return depth_evidence(xy, matched.pairs, np.array(spread), inliers.__getitem__, cameras)


def _centred(xy: NDArray[np.float32], camera: pycolmap.Camera) -> Floats:
    """Undistorted positions relative to the principal point, in units of the longer image side."""
    focal_length = camera.mean_focal_length() / max(camera.width, camera.height)
    rays = np.asarray(camera.cam_from_img(xy.astype(np.float64)), np.float64)
    return np.asarray(rays[:, :2] * focal_length)


def _turn_and_zoom_residuals(a: Floats, b: Floats) -> Floats:
    """Fit a rotation and zoom to matches for each focal length, and return the residuals.

    Args:
        a: float64 [n, 2] in the first image, see `_centred`.
        b: float64 [n, 2] in the second image.

    Returns:
        float64 [num_focal_lengths, n] in units of the longer image side, divided by the zoom if
        that is above 1.
    """
    focal = _FOCAL_LENGTHS[:, None]
    rays = np.stack(
        [
            a[:, 0] / focal,
            a[:, 1] / focal,
            np.ones((len(focal), len(a))),
        ],
        axis=1,
    )
    # A similarity is a good initial value, even if the camera rolls.
    complex_a, complex_b = ((x - np.median(x, axis=0)) @ np.array([1.0, 1.0j]) for x in (a, b))
    similarity = np.vdot(complex_a, complex_b) / max(np.vdot(complex_a, complex_a).real, 1e-12)
    roll = float(np.angle(similarity))
    rotation = np.tile(_rotations(np.array([[0.0, 0.0, roll]])), (len(focal), 1, 1))
    zoom = np.full(
        len(focal), np.clip(np.log(abs(similarity) + 1e-12), -_LARGEST_ZOOM, _LARGEST_ZOOM)
    )
    loss = _FIRST_LOSS
    for step in range(_NUM_STEPS + 1):
        x, y, z = np.moveaxis(rotation @ rays, 1, 0)
        x, y = x / np.maximum(z, _MIN_DEPTH), y / np.maximum(z, _MIN_DEPTH)
        scale = focal * np.exp(zoom)[:, None]
        residual = np.stack([scale * x - b[:, 0], scale * y - b[:, 1]], axis=2)
        distance = np.hypot(residual[..., 0], residual[..., 1])
        if step == _NUM_STEPS:
            break
        # Derivatives with respect to a rotation about each axis and the logarithm of the zoom.
        jacobian = scale[..., None, None] * np.stack(
            [
                np.stack([-x * y, 1 + x * x, -y, x], axis=2),
                np.stack([-1 - y * y, x * y, x, y], axis=2),
            ],
            axis=2,
        )
        weight = 1 / (1 + (distance / loss) ** 2)
        normal = np.einsum("fn,fnki,fnkj->fij", weight, jacobian, jacobian)
        gradient = np.einsum("fn,fnki,fnk->fi", weight, jacobian, residual)
        normal += 1e-9 * np.eye(4) * (1 + np.trace(normal, axis1=1, axis2=2))[:, None, None]
        change = -np.linalg.solve(normal, gradient[..., None])[..., 0]
        change = np.clip(change, -_LARGEST_STEP, _LARGEST_STEP)
        rotation = _rotations(change[:, :3]) @ rotation
        zoom = np.clip(zoom + change[:, 3], -_LARGEST_ZOOM, _LARGEST_ZOOM)
        loss = max(loss / 2, _LAST_LOSS)
    return np.asarray(distance / np.maximum(1.0, np.exp(zoom))[:, None])


def _rotations(vectors: Floats) -> Floats:
    """Rotation matrices [n, 3, 3] of rotation vectors [n, 3]."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow to import

    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())
