"""The focal length, estimated from tracks by least epipolar errors of image pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_models import poselib_camera

_Floats = NDArray[np.float64]

# Focal lengths that are tried, in longer sides of the image: fields of view from 127 to 18 degrees.
_SHORTEST, _LONGEST, _NUM_TRIED = 0.25, 3.2, 17
# Of a fisheye picture, how far from the centre matches count, in longer sides: beyond, errors of
# a pixel are several on a plane; and the widest angle to the axis, in radians.
_MIDDLE, _WIDEST = 0.35, 1.4
# Pairs that are looked at, one of each part of the video, and matches of each; about so many
# matches show which pair of a part has the widest parallax.
_NUM_PAIRS = 40
_NUM_MATCHES = 200
_NUM_GLANCED = 64
_MIN_PAIRS = 8
_MIN_MATCHES = 50
# Error in pixels from which on a match counts less (Cauchy's loss).
_LOSS_SCALE = 0.5
# A loss far below the precision of tracks means no more than this one.
_LEAST_LOSS = 1e-3
# A pose is searched with some of the matches and refined with all.
_NUM_SEARCHED = 64
_RANSAC = {"max_epipolar_error": 2.0, "max_iterations": 20, "min_iterations": 15}
_REFINEMENT = {"max_iterations": 12, "loss_type": "CAUCHY", "loss_scale": _LOSS_SCALE}
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
    fisheye: bool = False,
    seed: int = 0,
) -> float | None:
    """Estimate the focal length that all images share.

    For each of a range of focal lengths relative poses are fitted to pairs of wide parallax; the
    robust loss of their epipolar errors, its geometric mean over the pairs, is least at the true
    one. A single pair says little, many together do. The principal point counts as the centre, the
    lens as free of distortion, or as an equidistant fisheye lens, of which the picture's middle is
    looked at: a first guess for the mapper, a few per cent off.

    Args:
        keypoints: the images' keypoints.
        pairs: int32 [m, 2] indices into `keypoints`.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        fisheye: the lens is one.
        seed: the random seed.

    Returns:
        The focal length in pixel heights; None where the motion does not determine it, as
        where the camera moves along its axis, or in a plane circle around what it looks at, or
        where there are too few matches.
    """
    shape = np.array([pixel_aspect, 1.0])
    centre = np.array(size) * shape / 2
    rng = np.random.default_rng(seed)
    views = []
    for pair in _widest_pairs(keypoints, pairs, matches, shape):
        rows = rng.permutation(matches[pair])[:_NUM_MATCHES]
        i, j = pairs[pair]
        xa = keypoints[i].xy[rows[:, 0]].astype(np.float64) * shape - centre
        xb = keypoints[j].xy[rows[:, 1]].astype(np.float64) * shape - centre
        if fisheye:
            near = np.hypot(*xa.T), np.hypot(*xb.T)
            middle = np.maximum(*near) <= _MIDDLE * 2 * max(centre)
            xa, xb = xa[middle], xb[middle]
            if len(xa) < _MIN_MATCHES:
                continue
        views.append((xa, xb))
    if len(views) < _MIN_PAIRS:
        return None
    tried = max(centre) * 2 * np.geomspace(_SHORTEST, _LONGEST, _NUM_TRIED)
    loss = np.full((len(views), _NUM_TRIED), np.nan)

    def measure(rows: Iterable[int], columns: Iterable[int]) -> None:
        for row in rows:
            for k in columns:
                if np.isnan(loss[row, k]):
                    xa, xb = views[row]
                    if fisheye:
                        xa, xb = (_as_pinhole(x, float(tried[k])) for x in (xa, xb))
                    of_pose = pose_loss(xa, xb, float(tried[k]), seed)
                    loss[row, k] = math.log(of_pose + _LEAST_LOSS)

    # Half of the pairs show roughly where to look with all of them, until the lowest loss of all
    # and of either half lies between others.
    measure(range(0, len(views), 2), range(0, _NUM_TRIED, 2))
    rough = loss[::2].mean(axis=0)
    best = {int(np.nanargmin(rough))}
    looked: set[int] = set()
    while best - looked:
        around = {k + side for k in best for side in (-1, 0, 1) if 0 <= k + side < _NUM_TRIED}
        measure(range(len(views)), sorted(around))
        looked |= best
        curves = [part.mean(axis=0) for part in (loss, loss[::2], loss[1::2])]
        curves = [np.where(np.isfinite(curves[0]), curve, np.nan) for curve in curves]
        best = {int(np.nanargmin(curve)) for curve in curves}
    at = np.log(tried)
    found, *halves = (lowest(at, curve) for curve in curves)
    if found is None or None in halves:
        return None
    known = np.isfinite(rough)
    around_found = np.interp([found - math.log(2), found + math.log(2)], at[known], rough[known])
    risen = around_found.min() > rough[known].min() + math.log(_MIN_RISE)
    if not risen or abs(np.diff(np.array(halves, dtype=np.float64))[0]) > math.log(_MAX_FACTOR):
        return None
    return math.exp(found)


def _as_pinhole(x: _Floats, focal_length: float) -> _Floats:
    """Where a pinhole camera sees what an equidistant lens of its focal length sees at x."""
    away = np.hypot(*x.T)
    angle = np.minimum(away / focal_length, _WIDEST)
    return np.asarray(x * (focal_length * np.tan(angle) / np.maximum(away, 1e-9))[:, None])


def _widest_pairs(
    keypoints: Sequence[ImageKeypoints],
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    shape: _Floats,
) -> list[int]:
    """The pair with the most parallax in each part of the video, in order."""
    widest: dict[int, tuple[float, int]] = {}
    for pair, ((i, j), rows) in enumerate(zip(pairs.tolist(), matches, strict=True)):
        if len(rows) < _MIN_MATCHES:
            continue
        some = rows[:: max(1, len(rows) // _NUM_GLANCED)]
        motion = keypoints[j].xy.take(some[:, 1], axis=0) - keypoints[i].xy.take(some[:, 0], axis=0)
        motion = (motion - _median(motion)) * shape
        spread = float(_median(np.hypot(motion[:, 0], motion[:, 1])))
        part = i * _NUM_PAIRS // len(keypoints)
        if part not in widest or spread > widest[part][0]:
            widest[part] = (spread, pair)
    return [pair for _, (_, pair) in sorted(widest.items())]


def _median(values: NDArray[Any]) -> NDArray[Any]:
    """The median along the first axis, for few values in a fraction of the time of NumPy's."""
    ordered = np.sort(values, axis=0)
    half = len(values) // 2
    return np.asarray((ordered[half] + ordered[-half - 1]) / 2)


def pose_loss(xa: _Floats, xb: _Floats, focal_length: float, seed: int) -> float:
    """Mean robust loss of the epipolar errors of a pair for one focal length."""
    camera = poselib_camera(focal_length)
    some = slice(_NUM_SEARCHED)
    pose, _ = poselib.estimate_relative_pose(
        xa[some], xb[some], camera, camera, {**_RANSAC, "seed": seed}, {"max_iterations": 0}
    )
    _, refined = poselib.refine_relative_pose(xa, xb, pose, camera, camera, _REFINEMENT)
    # PoseLib's errors are on normalised coordinates: Sampson errors over the focal length.
    scale = _LOSS_SCALE / focal_length
    return float(refined["cost"]) / (scale * scale * len(xa))


def lowest(at: _Floats, value: _Floats) -> float | None:
    """Where a curve is lowest, by a parabola; None at an end. Samples that are NaN are left out."""
    k = int(np.nanargmin(value))
    if k in (0, len(at) - 1):
        return None
    before, least, after = value[k - 1 : k + 2]
    bend = before - 2 * least + after
    shift = (before - after) / (2 * bend) if bend > 0 else 0.0
    return float(at[k] + shift * (at[k + 1] - at[k]))
