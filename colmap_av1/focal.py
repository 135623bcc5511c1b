"""The focal length that tracks tell: the one with which pairs of images agree best."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from colmap_av1.pairs import ImageKeypoints

_Floats = NDArray[np.float64]

# Focal lengths that are tried, in longer sides of the image: fields of view from 127 to 18 degrees.
_SHORTEST, _LONGEST, _NUM_TRIED = 0.25, 3.2, 17
# Pairs that are looked at, one of each part of the video, and matches of each.
_NUM_PAIRS = 40
_NUM_MATCHES = 200
_MIN_PAIRS = 8
_MIN_MATCHES = 50
# Error in pixels from which on a match counts less (Cauchy's loss).
_LOSS_SCALE = 0.5
_RANSAC = {"max_epipolar_error": 2.0, "max_iterations": 200, "min_iterations": 15}
_REFINEMENT = {"max_iterations": 20, "loss_type": "CAUCHY", "loss_scale": _LOSS_SCALE}
# By how much the loss has to rise where the focal length is half or twice as long, and how far
# apart the focal lengths of every second pair and of the others may be, as a factor.
_MIN_RISE = 1.03
_MAX_FACTOR = 1.3


def estimate_focal_length(
    keypoints: Sequence[ImageKeypoints],
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    size: tuple[int, int],
    *,
    pixel_aspect: float = 1.0,
    seed: int = 0,
) -> float | None:
    """Estimate the focal length that all images share.

    For each of a range of focal lengths relative poses are fitted to pairs of wide parallax; the
    robust loss of their epipolar errors, averaged over the pairs, is least at the true one. A
    single pair tells little, many together do. The principal point counts as the centre, the
    lens as free of distortion: a first guess for the mapper, a few per cent off.

    Args:
        keypoints: the images' keypoints.
        pairs: int32 [m, 2] indices into `keypoints`.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        seed: the random seed.

    Returns:
        The focal length in heights of a pixel; None where the motion does not tell it, as where
        the camera moves along its axis, or in a plane circle around what it looks at, or where
        too few matches do.
    """
    shape = np.array([pixel_aspect, 1.0])
    centre = np.array(size) * shape / 2
    rng = np.random.default_rng(seed)
    chosen: dict[int, tuple[float, _Floats, _Floats]] = {}
    for (i, j), all_rows in zip(pairs.tolist(), matches, strict=True):
        if len(all_rows) < _MIN_MATCHES:
            continue
        rows = all_rows[rng.permutation(len(all_rows))[:_NUM_MATCHES]]
        xa = keypoints[i].xy[rows[:, 0]].astype(np.float64) * shape - centre
        xb = keypoints[j].xy[rows[:, 1]].astype(np.float64) * shape - centre
        motion = xb - xa
        spread = float(np.median(np.linalg.norm(motion - np.median(motion, axis=0), axis=1)))
        part = i * _NUM_PAIRS // len(keypoints)
        if part not in chosen or spread > chosen[part][0]:
            chosen[part] = (spread, xa, xb)
    if len(chosen) < _MIN_PAIRS:
        return None
    tried = max(centre) * 2 * np.geomspace(_SHORTEST, _LONGEST, _NUM_TRIED)
    loss = np.array(
        [
            [_loss(xa, xb, focal_length, seed) for focal_length in tried.tolist()]
            for _, (_, xa, xb) in sorted(chosen.items())
        ]
    )
    at = np.log(tried)
    found = _lowest(at, loss.mean(axis=0))
    halves = [_lowest(at, loss[k::2].mean(axis=0)) for k in (0, 1)]
    if found is None or None in halves:
        return None
    around = np.interp([found - math.log(2), found + math.log(2)], at, loss.mean(axis=0))
    risen = around.min() > _MIN_RISE * loss.mean(axis=0).min()
    if not risen or abs(np.diff(np.array(halves, dtype=np.float64))[0]) > math.log(_MAX_FACTOR):
        return None
    return math.exp(found)


def _loss(xa: _Floats, xb: _Floats, focal_length: float, seed: int) -> float:
    """Mean robust loss of the epipolar errors of a pair for one focal length."""
    camera: dict[str, Any] = {
        "model": "SIMPLE_PINHOLE",
        # PoseLib does not use the size.
        "width": 1,
        "height": 1,
        "params": [focal_length, 0.0, 0.0],
    }
    ransac = {**_RANSAC, "seed": seed}
    pose, _ = poselib.estimate_relative_pose(xa, xb, camera, camera, ransac, _REFINEMENT)
    rotation, translation = np.asarray(pose.R), np.asarray(pose.t).reshape(3)
    # Row by row the cross product with the translation.
    essential = np.cross(translation, rotation, axisb=0).T
    inverse = np.diag([1 / focal_length, 1 / focal_length, 1.0])
    fundamental = inverse @ essential @ inverse
    lines_b = np.column_stack([xa, np.ones(len(xa))]) @ fundamental.T
    lines_a = np.column_stack([xb, np.ones(len(xb))]) @ fundamental
    algebraic = np.einsum("ni,ni->n", xb, lines_b[:, :2]) + lines_b[:, 2]
    gradient = (lines_a[:, :2] ** 2).sum(axis=1) + (lines_b[:, :2] ** 2).sum(axis=1)
    # Sampson error (Hartley and Zisserman, eq. 11.9).
    error = algebraic**2 / np.maximum(gradient, np.finfo(np.float64).tiny)
    return float(np.log1p(error / _LOSS_SCALE**2).mean())


def _lowest(at: _Floats, value: _Floats) -> float | None:
    """Where a sampled curve is lowest, by a parabola; None at an end."""
    k = int(np.argmin(value))
    if k in (0, len(at) - 1):
        return None
    before, least, after = value[k - 1 : k + 2]
    bend = before - 2 * least + after
    shift = (before - after) / (2 * bend) if bend > 0 else 0.0
    return float(at[k] + shift * (at[k + 1] - at[k]))
