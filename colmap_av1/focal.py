"""The focal length that tracks tell: the one with which pairs of images agree best."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
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
# A pose is searched with some of the matches and refined with all.
_NUM_SEARCHED = 64
_RANSAC = {"max_epipolar_error": 2.0, "max_iterations": 100, "min_iterations": 15}
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
    views = [(xa, xb) for _, (_, xa, xb) in sorted(chosen.items())]
    loss = np.full((len(views), _NUM_TRIED), np.nan)

    def measure(columns: Iterable[int]) -> None:
        for k in columns:
            loss[:, k] = [_loss(xa, xb, float(tried[k]), seed) for xa, xb in views]

    def curves() -> list[_Floats]:
        return [loss.mean(axis=0), loss[::2].mean(axis=0), loss[1::2].mean(axis=0)]

    # Every second one, then those beside the best.
    measure(range(0, _NUM_TRIED, 2))
    best = [int(np.nanargmin(curve)) for curve in curves()]
    measure(sorted({k + side for k in best for side in (-1, 1) if 0 <= k + side < _NUM_TRIED}))
    at = np.log(tried)
    found, *halves = (_lowest(at, curve) for curve in curves())
    if found is None or None in halves:
        return None
    mean = loss.mean(axis=0)
    known = np.isfinite(mean)
    around = np.interp([found - math.log(2), found + math.log(2)], at[known], mean[known])
    risen = around.min() > _MIN_RISE * mean[known].min()
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
    some = slice(_NUM_SEARCHED)
    pose, _ = poselib.estimate_relative_pose(
        xa[some], xb[some], camera, camera, {**_RANSAC, "seed": seed}, {"max_iterations": 0}
    )
    _, refined = poselib.refine_relative_pose(xa, xb, pose, camera, camera, _REFINEMENT)
    # PoseLib's errors are on normalised coordinates: Sampson errors over the focal length.
    scale = _LOSS_SCALE / focal_length
    return float(refined["cost"]) / (scale * scale * len(xa))


def _lowest(at: _Floats, value: _Floats) -> float | None:
    """Where a curve is lowest, by a parabola; None at an end. Samples that are NaN are left out."""
    k = int(np.nanargmin(value))
    if k in (0, len(at) - 1):
        return None
    before, least, after = value[k - 1 : k + 2]
    bend = before - 2 * least + after
    shift = (before - after) / (2 * bend) if bend > 0 else 0.0
    return float(at[k] + shift * (at[k + 1] - at[k]))
