"""Two-view geometry of image pairs: which matches agree with a rigid scene, and how.

The models come from PoseLib's robust estimators on a sample of the matches that is spread
over the image; every match is then tested against them. The decisions between the models
and all thresholds are those COLMAP documents for its own geometric verification
(`TwoViewGeometryOptions`), so a database filled here and one filled by COLMAP's matchers
mean the same.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import OptionError
from colmap_av1.options import VerifyOptions
from colmap_av1.pairs import ImageKeypoints


class TwoViewConfig(IntEnum):
    """Kinds of two-view geometry, numbered as in COLMAP's databases."""

    DEGENERATE = 1
    CALIBRATED = 2
    UNCALIBRATED = 3
    PLANAR_OR_PANORAMIC = 6


@dataclass(frozen=True)
class TwoViewGeometry:
    """Geometry of one image pair, from the pair's first image to its second.

    Attributes:
        config: kind of geometry.
        inlier_matches: uint32 [n, 2] the matches that agree with it, in their order.
        E: float64 [3, 3] essential matrix on normalised, undistorted coordinates, or None.
        F: float64 [3, 3] fundamental matrix on pixels, or None, also where E explains so many
            matches that F was not needed.
        H: float64 [3, 3] homography on pixels, or None.
        qvec: float64 [4] (w, x, y, z) rotation from the first camera to the second, or None.
        tvec: float64 [3] translation likewise, of unit length, or None.
    """

    config: TwoViewConfig
    inlier_matches: NDArray[np.uint32]
    E: NDArray[np.float64] | None = None
    F: NDArray[np.float64] | None = None
    H: NDArray[np.float64] | None = None
    qvec: NDArray[np.float64] | None = None
    tvec: NDArray[np.float64] | None = None


def verify_pairs(
    keypoints: Sequence[ImageKeypoints],
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera],
    options: VerifyOptions | None = None,
    *,
    progress: Callable[[int], None] | None = None,
) -> list[TwoViewGeometry]:
    """Find the two-view geometry of every pair.

    A pair of cameras with a focal length prior is CALIBRATED where the essential matrix
    explains nearly as many matches as the fundamental matrix, any other UNCALIBRATED; where
    a homography explains them as well, PLANAR_OR_PANORAMIC; with too few inliers DEGENERATE.

    Args:
        keypoints: the images' keypoints.
        pairs: int32 [m, 2] indices into `keypoints`.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        cameras: the camera of all images, or one for each.
        options: thresholds and effort; the defaults of VerifyOptions if None.
        progress: called with the number of pairs done so far, from this thread, in order.

    Returns:
        One geometry per pair, in the order of `pairs`. The result depends on the input and
        `options.seed` only, not on the number of threads.

    Raises:
        OptionError: an option has a value that cannot work, or a camera is not a perspective
            one.
    """
    options = options if options is not None else VerifyOptions()
    _check_options(options)
    if isinstance(cameras, pycolmap.Camera):
        cameras = [cameras] * len(keypoints)
    if len(cameras) != len(keypoints) or len(matches) != len(pairs):
        raise ValueError("give one camera for each image and one array of matches for each pair")
    views = [_view(k, camera) for k, camera in zip(keypoints, cameras, strict=True)]

    def verify(index: int) -> TwoViewGeometry:
        i, j = (int(k) for k in pairs[index])
        return _verify_pair(views[i], views[j], matches[index], (i, j), options)

    geometries: list[TwoViewGeometry] = []
    num_threads = options.num_threads if options.num_threads is not None else _num_cpus()
    # PoseLib and NumPy's loops release the interpreter lock, so threads are enough.
    with ThreadPoolExecutor(max_workers=num_threads) as executor:
        try:
            for geometry in executor.map(verify, range(len(pairs))):
                geometries.append(geometry)
                if progress is not None:
                    progress(len(geometries))
        except BaseException:
            executor.shutdown(wait=True, cancel_futures=True)
            raise
    return geometries


@dataclass(frozen=True)
class _View:
    """Keypoints of an image as the estimators take them.

    Attributes:
        pixels: float64 [n, 2] keypoints.
        rays: float64 [n, 2] normalised, undistorted coordinates; None without a focal prior.
        focal: mean focal length in pixels.
        camera: the pinhole camera, in PoseLib's words, whose pixels are `rays * focal`.
        size: (width, height) in pixels.
    """

    pixels: NDArray[np.float64]
    rays: NDArray[np.float64] | None
    focal: float
    camera: dict[str, Any]
    size: tuple[int, int]


def _view(keypoints: ImageKeypoints, camera: pycolmap.Camera) -> _View:
    size = (int(camera.width), int(camera.height))
    pixels = keypoints.xy.astype(np.float64)
    rays = None
    focal = 1.0
    if camera.has_prior_focal_length:
        rays = np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)
        if pixels.size and np.isnan(rays).all():
            raise OptionError(
                f"camera model {camera.model_name} maps no keypoint to a ray in front of the "
                "camera: give a perspective or fisheye model and parameters in pixels"
            )
        focal = float(camera.mean_focal_length())
    pinhole = {
        "model": "SIMPLE_PINHOLE",
        "width": size[0],
        "height": size[1],
        "params": [focal, 0.0, 0.0],
    }
    return _View(pixels, rays, focal, pinhole, size)


def _verify_pair(
    a: _View,
    b: _View,
    matches: NDArray[np.uint32],
    pair: tuple[int, int],
    options: VerifyOptions,
) -> TwoViewGeometry:
    """Choose the model of one pair as COLMAP does (EstimateTwoViewGeometry's rules)."""
    num_needed = options.min_num_inliers
    if len(matches) < max(num_needed, _MIN_MATCHES):
        return _degenerate()
    xa, xb = a.pixels[matches[:, 0]], b.pixels[matches[:, 1]]
    seed = int(np.random.SeedSequence([options.seed, *pair]).generate_state(1)[0])
    sample = _spread_sample(xa, a.size, options.max_samples, seed)
    ransac = {
        "max_epipolar_error": options.max_error,
        "max_reproj_error": options.max_error,
        "max_iterations": options.max_iterations,
        "min_iterations": min(_MIN_ITERATIONS, options.max_iterations),
        "success_prob": options.confidence,
        "seed": seed,
    }

    E = pose = None
    E_inliers = np.zeros(len(matches), dtype=bool)
    if a.rays is not None and b.rays is not None:
        ra, rb = a.rays[matches[:, 0]], b.rays[matches[:, 1]]
        pose, E, E_inliers = _estimate_pose(
            a, b, ra, rb, sample=sample, ransac=ransac, max_error=options.max_error
        )
    num_E = int(E_inliers.sum())

    # F cannot have more inliers than there are matches: where E comes that close, the pair
    # is calibrated whatever F says, and the search for it is the costliest part.
    F = None
    F_inliers = np.zeros(len(matches), dtype=bool)
    if num_E < num_needed or num_E <= options.min_e_f_inlier_ratio * len(matches):
        F = _usable(poselib.estimate_fundamental(xa[sample], xb[sample], ransac, {})[0])
        F_inliers = _epipolar_inliers(F, xa, xb, options.max_error)
    num_F = int(F_inliers.sum())

    # A homography is only chosen where it explains this share of the matches; looking for
    # a weaker one, until PoseLib gives up, would be the most expensive part of all.
    num_rival = min((count for count in (num_E, num_F) if count > 0), default=0)
    effort = _num_iterations(options.max_h_inlier_ratio * num_rival / len(matches), options)
    H, _ = poselib.estimate_homography(
        xa[sample], xb[sample], {**ransac, "max_iterations": effort}, {}
    )
    H = _usable(H)
    H_inliers = _transfer_inliers(H, xa, xb, options.max_error)
    num_H = int(H_inliers.sum())

    calibrated = num_E >= num_needed and num_E > options.min_e_f_inlier_ratio * num_F
    if calibrated:
        config = TwoViewConfig.CALIBRATED
        epipolar_inliers = E_inliers if num_E >= num_F else F_inliers
    elif num_F >= num_needed:
        config = TwoViewConfig.UNCALIBRATED
        epipolar_inliers = F_inliers
    elif num_H >= num_needed:
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        epipolar_inliers = H_inliers
    else:
        return _degenerate()
    inliers = epipolar_inliers
    if num_H > options.max_h_inlier_ratio * (num_E if calibrated else num_F):
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if num_H > np.count_nonzero(inliers):
            inliers = H_inliers

    # A pose means nothing where a homography explains the matches as well.
    qvec = tvec = None
    if config == TwoViewConfig.CALIBRATED and pose is not None:
        qvec = np.asarray(pose.q, dtype=np.float64).reshape(4)
        tvec = np.asarray(pose.t, dtype=np.float64).reshape(3)
    return TwoViewGeometry(
        config=config,
        inlier_matches=np.ascontiguousarray(matches[inliers], dtype=np.uint32),
        E=E,
        F=F,
        H=H,
        qvec=qvec,
        tvec=tvec,
    )


# A fundamental matrix takes seven matches; an eighth is the first that can disagree.
_MIN_MATCHES = 8
_MIN_ITERATIONS = 100
# Share of inliers below which COLMAP spends no more iterations on a model.
_MIN_INLIER_RATIO = 0.25


def _degenerate() -> TwoViewGeometry:
    return TwoViewGeometry(TwoViewConfig.DEGENERATE, np.empty((0, 2), dtype=np.uint32))


def _estimate_pose(
    a: _View,
    b: _View,
    rays_a: NDArray[np.float64],
    rays_b: NDArray[np.float64],
    *,
    sample: NDArray[np.int64],
    ransac: dict[str, Any],
    max_error: float,
) -> tuple[Any, NDArray[np.float64] | None, NDArray[np.bool_]]:
    """Estimate the relative pose on a sample and test it on all matches.

    Returns:
        PoseLib's pose and the essential matrix, both None where none was found, and bool [n]
        inliers among all matches. Errors are measured in undistorted pixels.
    """
    xa, xb = rays_a * a.focal, rays_b * b.focal
    sample = sample[np.isfinite(xa[sample]).all(axis=1) & np.isfinite(xb[sample]).all(axis=1)]
    none = None, None, np.zeros(len(rays_a), dtype=bool)
    if len(sample) < _MIN_MATCHES:
        return none
    pose, _ = poselib.estimate_relative_pose(xa[sample], xb[sample], a.camera, b.camera, ransac, {})
    R, t = np.asarray(pose.R), np.asarray(pose.t).reshape(3)
    E = _usable(np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]]) @ R)
    if E is None:
        return none
    on_pixels = E / np.outer([b.focal, b.focal, 1.0], [a.focal, a.focal, 1.0])
    return pose, E, _epipolar_inliers(on_pixels, xa, xb, max_error)


def _spread_sample(
    x: NDArray[np.float64], size: tuple[int, int], max_samples: int, seed: int
) -> NDArray[np.int64]:
    """Choose at most `max_samples` points that are spread over the image.

    The image is divided into about as many cells as points are wanted; every cell gives one
    random point before any gives its second, and so on.

    Args:
        x: float64 [n, 2] points in pixels.
        size: (width, height) of the image.
        max_samples: number of points wanted.
        seed: seed of the random order within a cell.

    Returns:
        int64 indices into `x`, ascending.
    """
    if len(x) <= max_samples:
        return np.arange(len(x))
    edge = math.sqrt(size[0] * size[1] / max_samples)
    order = np.random.default_rng(seed).permutation(len(x))
    cell = np.floor(x[order] / edge).astype(np.int64)
    key = cell[:, 1] * (size[0] + 1) + cell[:, 0]
    by_cell = np.argsort(key, kind="stable")
    starts = np.flatnonzero(np.diff(key[by_cell], prepend=key[by_cell[0]] - 1))
    turn = np.empty(len(x), dtype=np.int64)
    turn[by_cell] = np.arange(len(x)) - np.repeat(starts, np.diff(np.append(starts, len(x))))
    return np.sort(order[np.argsort(turn, kind="stable")[:max_samples]])


def _num_iterations(inlier_ratio: float, options: VerifyOptions) -> int:
    """Iterations after which a homography with this share of inliers is found or absent."""
    clean = max(inlier_ratio, _MIN_INLIER_RATIO) ** 4
    if clean >= 1 or options.confidence >= 1:
        wanted = options.max_iterations if options.confidence >= 1 else 1
    else:
        # Three times the textbook number, as COLMAP does: samples are noisy.
        wanted = math.ceil(3 * math.log(1 - options.confidence) / math.log(1 - clean))
    return min(max(wanted, _MIN_ITERATIONS), options.max_iterations)


def _usable(model: Any) -> NDArray[np.float64] | None:
    """The model scaled to unit norm, or None where the estimator found none."""
    model = np.asarray(model, dtype=np.float64)
    norm = float(np.linalg.norm(model))
    return model / norm if math.isfinite(norm) and norm > 0 else None


def _epipolar_inliers(
    F: NDArray[np.float64] | None,
    xa: NDArray[np.float64],
    xb: NDArray[np.float64],
    max_error: float,
) -> NDArray[np.bool_]:
    """Matches whose Sampson error (Hartley and Zisserman, eq. 11.9) is within `max_error`."""
    if F is None:
        return np.zeros(len(xa), dtype=bool)
    lines_b = xa @ F[:, :2].T + F[:, 2]
    lines_a = xb @ F[:2] + F[2]
    algebraic = np.einsum("ij,ij->i", xb, lines_b[:, :2]) + lines_b[:, 2]
    gradient = (lines_b[:, :2] ** 2).sum(axis=1) + (lines_a[:, :2] ** 2).sum(axis=1)
    return np.asarray(algebraic**2 <= max_error**2 * gradient)


def _transfer_inliers(
    H: NDArray[np.float64] | None,
    xa: NDArray[np.float64],
    xb: NDArray[np.float64],
    max_error: float,
) -> NDArray[np.bool_]:
    """Matches that H maps to within `max_error` of their place in the second image."""
    if H is None:
        return np.zeros(len(xa), dtype=bool)
    mapped = xa @ H[:, :2].T + H[:, 2]
    # Multiplied out by the third coordinate, so no point at infinity divides by zero.
    error = mapped[:, :2] - xb * mapped[:, 2:]
    return np.asarray((error**2).sum(axis=1) <= (max_error * mapped[:, 2]) ** 2)


def _num_cpus() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _check_options(options: VerifyOptions) -> None:
    if not 0 < options.max_error < math.inf:
        raise OptionError(f"max_error is {options.max_error}: give a number of pixels above 0")
    if options.min_num_inliers < 1:
        raise OptionError(f"min_num_inliers is {options.min_num_inliers}: give 1 or more")
    for name in ("min_e_f_inlier_ratio", "max_h_inlier_ratio", "confidence"):
        value = getattr(options, name)
        if not 0 <= value <= 1:
            raise OptionError(f"{name} is {value}: give a share from 0 to 1")
    for name, least in (("max_samples", _MIN_MATCHES), ("max_iterations", 1), ("seed", 0)):
        value = getattr(options, name)
        if value < least:
            raise OptionError(f"{name} is {value}: give {least} or more")
    if options.num_threads is not None and options.num_threads < 1:
        raise OptionError(f"num_threads is {options.num_threads}: give 1 or more, or None")
