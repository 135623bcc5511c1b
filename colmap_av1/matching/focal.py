"""Estimate the focal length by minimizing the epipolar errors of image pairs."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import poselib
from numpy.typing import NDArray

from colmap_av1.geometry.cameras import poselib_camera
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.util.arrays import Floats

# Focal lengths to try, in units of the longer image side: fields of view from 127 to 18 degrees.
_SHORTEST, _LONGEST, _NUM_TRIED = 0.25, 3.2, 17
# A fisheye image is used up to this distance from its centre, in units of the longer image side:
# farther out, an error of a pixel becomes several pixels on the plane of a pinhole camera.
_FISHEYE_RADIUS = 0.35
# Largest angle between a fisheye ray and the optical axis, in radians.
_WIDEST = 1.4
# Number of pairs, one in each part of the video: one for this many images, within these limits. A
# part with fewer images may have no pair with wide parallax. Of `cafe`, 200 images of a walk with
# fast turns, 40 pairs give no estimate, and 80 pairs one that is 5 % off.
_IMAGES_PER_PAIR, _LEAST_PAIRS, _MOST_PAIRS = 2.5, 40, 80
# Number of matches per pair. About the second number of matches of each candidate is enough to
# choose the pair with the widest parallax.
_NUM_MATCHES = 200
_NUM_COMPARED = 64
_MIN_PAIRS = 8
_MIN_MATCHES = 50
# Scale of the Cauchy loss in pixels.
_LOSS_SCALE = 0.5
# Added to a loss before its logarithm: differences far below the precision of tracks are noise.
_LEAST_LOSS = 1e-3
# A pose is estimated from this many matches and refined with all.
_NUM_SEARCHED = 64
_RANSAC = {"max_epipolar_error": 2.0, "max_iterations": 20, "min_iterations": 15}
_REFINEMENT = {"max_iterations": 12, "loss_type": "CAUCHY", "loss_scale": _LOSS_SCALE}
# The estimate is rejected unless the loss rises by the first factor at half and at twice the focal
# length, or if the estimates from even and odd pairs differ by more than the second factor. Below
# the first factor, the estimate was twice the true one in a room (`kitchen`). On walks with turns,
# estimates of even and odd pairs differed by up to 1.6, and that from all was at most 15 % off.
# Without an estimate, a mapper would refine the default focal length along with its first images,
# which may diverge.
_MIN_RISE = 1.03
_MAX_FACTOR = 1.65


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

    Relative poses are fitted to pairs with wide parallax for a range of focal lengths. The true
    focal length minimizes the geometric mean over all pairs of the robust epipolar loss; a single
    pair determines it poorly. The principal point is assumed to be the image centre, and the lens
    to be free of distortion, or an equidistant fisheye lens, of which only the middle of the image
    is used. The result is an initial value for the mapper, a few per cent off.

    Args:
        keypoints: the images' keypoints.
        pairs: int32 [m, 2] indices into `keypoints`.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        fisheye: whether the lens is a fisheye lens.
        seed: the random seed.

    Returns:
        The focal length in pixel heights. None if it is not observable, for example if the camera
        moves along its axis or in a flat circle around what it looks at, or if there are too few
        matches.
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
            middle = np.maximum(*near) <= _FISHEYE_RADIUS * 2 * max(centre)
            xa, xb = xa[middle], xb[middle]
            if len(xa) < _MIN_MATCHES:
                continue
        if _are_on_line(xa) or _are_on_line(xb):
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
                    pair_loss = pose_loss(xa, xb, float(tried[k]), seed)
                    loss[row, k] = math.log(pair_loss + _LEAST_LOSS)

    # Half of the pairs locate the minimum roughly. Then all pairs are evaluated around the minimum
    # of all and of either half, until each of these minima lies between evaluated samples.
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


def _are_on_line(x: Floats) -> bool:
    """Whether points, in pixels, lie on a line, so that they determine no pose."""
    across = np.linalg.svd(x - x.mean(axis=0), compute_uv=False)[1]
    return bool(across < math.sqrt(len(x)))


def _as_pinhole(x: Floats, focal_length: float) -> Floats:
    """Map points of an equidistant fisheye image to a pinhole image with the same focal length."""
    away = np.hypot(*x.T)
    angle = np.minimum(away / focal_length, _WIDEST)
    return np.asarray(x * (focal_length * np.tan(angle) / np.maximum(away, 1e-9))[:, None])


def _widest_pairs(
    keypoints: Sequence[ImageKeypoints],
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    shape: Floats,
) -> list[int]:
    """Find the pair with the most parallax in each part of the video, in order."""
    num_parts = round(np.clip(len(keypoints) / _IMAGES_PER_PAIR, _LEAST_PAIRS, _MOST_PAIRS))
    widest: dict[int, tuple[float, int]] = {}
    for pair, ((i, j), rows) in enumerate(zip(pairs.tolist(), matches, strict=True)):
        if len(rows) < _MIN_MATCHES:
            continue
        some = rows[:: max(1, len(rows) // _NUM_COMPARED)]
        motion = keypoints[j].xy.take(some[:, 1], axis=0) - keypoints[i].xy.take(some[:, 0], axis=0)
        motion = (motion - _median(motion)) * shape
        spread = float(_median(np.hypot(motion[:, 0], motion[:, 1])))
        part = i * num_parts // len(keypoints)
        if part not in widest or spread > widest[part][0]:
            widest[part] = (spread, pair)
    return [pair for _, (_, pair) in sorted(widest.items())]


def _median(values: NDArray[Any]) -> NDArray[Any]:
    """The median along the first axis; for few values much faster than `numpy.median`."""
    ordered = np.sort(values, axis=0)
    half = len(values) // 2
    return np.asarray((ordered[half] + ordered[-half - 1]) / 2)


def pose_loss(xa: Floats, xb: Floats, focal_length: float, seed: int) -> float:
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


def lowest(at: Floats, value: Floats) -> float | None:
    """Find the minimum of a curve with a parabola, skipping NaN; None if it is at an end."""
    k = int(np.nanargmin(value))
    if k in (0, len(at) - 1):
        return None
    before, least, after = value[k - 1 : k + 2]
    bend = before - 2 * least + after
    shift = (before - after) / (2 * bend) if bend > 0 else 0.0
    return float(at[k] + shift * (at[k + 1] - at[k]))
