"""Whether matches determine depth, or come from a camera that only turns or zooms."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.image_matches import MatchedImages

_Floats = NDArray[np.float64]

# Focal lengths that are tried, in longer sides of the image. With longer ones a turn looks like a
# camera that moves along a plane.
_FOCAL_LENGTHS = np.geomspace(0.4, 1.2, 14)
# Pairs that are looked at, the one with the widest motion in each part of the images, and matches
# of each.
_NUM_PAIRS = 40
_NUM_MATCHES = 100
LEAST_MATCHES = 30
# A pair has parallax if this quantile of its residuals is above this length, in longer sides:
# 0.4 to 0.5 degrees. Up to one pair in ten of a hand-held zoom exceeds it, as the lens changes its
# distortion. So do more than half of the pairs of a flight over a plain, and nearly all pairs of
# walks and drives.
_QUANTILE, _LEAST_PARALLAX = 0.75, 8.5e-3
# Depth is not observable if fewer pairs than the first share have parallax, and unreliable if fewer
# than the second.
_FEWEST, _FEW = 0.25, 0.4
# Gauss-Newton steps, and the residual from which on a match counts less, in longer sides: it is
# halved from step to step.
_NUM_STEPS = 10
_FIRST_LOSS, _LAST_LOSS = 0.032, 1e-3
# Changes of a step are limited: radians, and the logarithm of the zoom, which is limited, too.
_LARGEST_STEP, _LARGEST_ZOOM = 0.3, 2.0
_BEHIND = 1e-3


@dataclass(frozen=True)
class DepthEvidence:
    """How many pairs of images show parallax.

    Attributes:
        num_pairs: pairs that were looked at, those with the widest motion.
        num_with_parallax: those whose motion no turn and zoom of the camera explains.
    """

    num_pairs: int
    num_with_parallax: int

    @property
    def is_observable(self) -> bool:
        """Whether the matches determine depth at all; so it is if no pair was looked at."""
        return self.num_with_parallax >= _FEWEST * self.num_pairs

    @property
    def warning(self) -> str | None:
        """What the user should know."""
        if not self.is_observable:
            return (
                "depth is not observable: the camera stands still, or only turns or zooms: film "
                "while moving sideways, or give a longer part of the video"
            )
        if self.num_with_parallax < _FEW * self.num_pairs:
            return (
                "in most parts of the images the camera only turns or zooms: the depth of points "
                "may be unreliable there: film while moving sideways"
            )
        return None


def motion_spread(a: NDArray[np.float32], b: NDArray[np.float32]) -> float:
    """How far the displacements of matches [n, 2] differ, in pixels."""
    motion = b.astype(np.float64) - a
    return float(np.hypot(*np.subtract(*np.quantile(motion, (0.9, 0.1), axis=0))))


def depth_evidence(
    keypoints: Sequence[NDArray[np.float32]],
    pairs: NDArray[np.integer],
    spread: NDArray[np.float64],
    matches: Callable[[int], NDArray[np.integer]],
    cameras: Sequence[pycolmap.Camera | None],
) -> DepthEvidence:
    """Look for parallax in the pairs of images with the widest motion.

    A camera that turns and zooms maps one image to another by K2 R K1^-1 (Hartley and Zisserman,
    8.4.2), whatever the depth. This map is fitted to each pair, for a range of focal lengths of the
    first image, as a zoom makes any estimate of it meaningless. A plane seen by a camera that moves
    sideways fits it only with focal lengths beyond this range.

    Args:
        keypoints: float32 [n, 2] of each image, in pixels, first pixel's centre at (0.5, 0.5).
        pairs: [m, 2] indices of images.
        spread: float64 [m] the spread of each pair's motion, see `motion_spread`.
        matches: returns the verified matches of a pair, [n, 2] indices of keypoints.
        cameras: the camera of each image; its distortion is taken out. Pairs of images without one
            are left out.
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
    return DepthEvidence(len(parallax), int(np.sum(np.array(parallax) > _LEAST_PARALLAX)))


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


def _centred(xy: NDArray[np.float32], camera: pycolmap.Camera) -> _Floats:
    """Undistorted positions from the principal point, in longer sides of the image."""
    focal_length = camera.mean_focal_length() / max(camera.width, camera.height)
    rays = np.asarray(camera.cam_from_img(xy.astype(np.float64)), np.float64)
    return np.asarray(rays[:, :2] * focal_length)


def _turn_and_zoom_residuals(a: _Floats, b: _Floats) -> _Floats:
    """Distances of matches from the turn and zoom that fits them, for each focal length tried.

    Args:
        a: float64 [n, 2] in the first image, see `_centred`.
        b: float64 [n, 2] in the second image.

    Returns:
        float64 [num_focal_lengths, n] in longer sides; those of a zoom in are divided by it.
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
    # A similarity is a good first guess, also where the camera rolls.
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
        x, y = x / np.maximum(z, _BEHIND), y / np.maximum(z, _BEHIND)
        scale = focal * np.exp(zoom)[:, None]
        residual = np.stack([scale * x - b[:, 0], scale * y - b[:, 1]], axis=2)
        distance = np.hypot(residual[..., 0], residual[..., 1])
        if step == _NUM_STEPS:
            break
        # Derivatives by a turn about each axis, and by the logarithm of the zoom.
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


def _rotations(vectors: _Floats) -> _Floats:
    """Rotation matrices [n, 3, 3] of rotation vectors [n, 3]."""
    from scipy.spatial.transform import Rotation  # noqa: PLC0415 - slow to import

    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())
