"""Geometric verification of image pairs.

The thresholds and the choice between models are those of COLMAP 4.2's geometric verification
(`TwoViewGeometryOptions`), so the database means the same as one filled by COLMAP's matchers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import OptionError
from colmap_av1.matching.epipolar import epipolar_inliers
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import FLAT_CONFIGS, TwoViewConfig, TwoViewGeometry
from colmap_av1.matching.two_view_models import (
    MAX_REFINED,
    Model,
    Search,
    find_fundamental,
    find_homography,
    find_pose,
    planar_share,
    spread_points,
    transfer_inliers,
)
from colmap_av1.options import VerifyOptions
from colmap_av1.options.matching import MIN_MATCHES
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.digests import seed_of
from colmap_av1.util.threads import map_on_threads

# Number of pairs that justifies another thread. Threads wait for the interpreter between PoseLib's
# steps: two threads use a third more CPU time to finish a tenth to a quarter sooner.
_PAIRS_FOR_A_THREAD = 2000
# Number of pairs that a thread verifies in one task.
_PAIRS_AT_A_TIME = 16
# Number of cells into which an image is divided to spread a sample of points.
_NUM_CELLS = 128


def verify_pairs(
    keypoints: Sequence[ImageKeypoints],
    pairs: NDArray[np.int32],
    matches: Sequence[NDArray[np.uint32]],
    cameras: pycolmap.Camera | Sequence[pycolmap.Camera],
    options: VerifyOptions = VerifyOptions(),
    *,
    num_threads: int | None = None,
    seed: int = 0,
    progress: Callable[[int], None] | None = None,
) -> list[TwoViewGeometry]:
    """Find the two-view geometry of every pair.

    If both cameras have a focal length prior and the essential matrix explains nearly as many
    matches as the fundamental matrix, the pair is CALIBRATED, otherwise UNCALIBRATED. If a
    homography explains nearly as many, it is PLANAR_OR_PANORAMIC. With too few inliers it is
    DEGENERATE.

    Args:
        keypoints: the images' keypoints.
        pairs: int32 [m, 2] indices into `keypoints`.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        cameras: one camera for all images, or one for each; images that share a camera hold the
            same object.
        options: thresholds and effort.
        num_threads: number of threads; if None, at most one per CPU that the process may use.
        seed: seed of the robust estimators.
        progress: called with the number of pairs done so far, from this thread, in order.

    Returns:
        One geometry per pair, in the order of `pairs`. The result depends on the input and
        `seed` only, not on the number of threads.

    Raises:
        OptionError: a camera maps no keypoint to a ray in front of it.
    """
    if isinstance(cameras, pycolmap.Camera):
        cameras = [cameras] * len(keypoints)
    if len(cameras) != len(keypoints) or len(matches) != len(pairs):
        raise ValueError("give one camera for each image and one array of matches for each pair")
    views: dict[int, _View] = {}  # kept from the first pair that needs an image to the last
    last_pair = {int(image): index for index, pair in enumerate(pairs) for image in pair}

    def view(image: int) -> _View:
        found = views.get(image)
        if found is None:
            # If two threads compute it at the same time, both results are equal.
            found = views[image] = _view(keypoints[image], cameras[image], seed_of(seed, image))
        return found

    def verify(some: range) -> list[TwoViewGeometry]:
        found = []
        for index in some:
            i, j = pairs[index].tolist()
            search = Search(options, seed_of(seed, i, j))
            found.append(_verify_pair(view(i), view(j), matches[index], search))
        return found

    geometries: list[TwoViewGeometry] = []
    # Tasks of single pairs would spend most of their time on scheduling.
    indices = range(len(pairs))
    parts = [indices[start : start + _PAIRS_AT_A_TIME] for start in indices[::_PAIRS_AT_A_TIME]]
    num_threads = min(threads_or_cpus(num_threads), 1 + len(pairs) // _PAIRS_FOR_A_THREAD)
    # PoseLib and NumPy's loops release the interpreter lock, so threads are enough.
    for part, found in zip(parts, map_on_threads(verify, parts, num_threads), strict=True):
        for image in np.unique(pairs[part.start : part.stop]).tolist():
            if last_pair[image] < part.stop:
                views.pop(image, None)
        for geometry in found:
            geometries.append(geometry)
            if progress is not None:
                progress(len(geometries))
    return geometries


@dataclass(frozen=True)
class _View:
    """Keypoints of an image, prepared for the estimators.

    Attributes:
        camera: the image's camera.
        xy: float32 [n, 2] keypoints.
        flat: float64 [2, n] undistorted keypoints in pixels relative to the principal point; None
            without a focal length prior.
        focal: mean focal length in pixels.
        to_flat: float64 [3, 3] maps undistorted pixels to `flat`.
        rank: int32 [n] rank of each keypoint in an order whose beginnings are all spread over the
            image.
    """

    camera: pycolmap.Camera
    xy: NDArray[np.float32]
    flat: Floats | None
    focal: float
    to_flat: Floats
    rank: NDArray[np.int32]


def _view(keypoints: ImageKeypoints, camera: pycolmap.Camera, seed: int) -> _View:
    width, height = int(camera.width), int(camera.height)
    pixels = keypoints.xy.astype(np.float64)
    flat = None
    focal = 1.0
    if camera.has_prior_focal_length:
        rays = np.asarray(camera.cam_from_img(pixels), dtype=np.float64).reshape(-1, 2)
        if pixels.size and np.isnan(rays).all():
            raise OptionError(
                f"camera model {camera.model_name} maps no keypoint to a ray in front of the "
                "camera: give a perspective or fisheye model and parameters in pixels"
            )
        focal = float(camera.mean_focal_length())
        flat = np.ascontiguousarray(rays.T * focal)
    rank = _spread_order(pixels, (width, height), seed)
    to_flat = np.diag([focal, focal, 1.0]) @ np.linalg.inv(camera.calibration_matrix())
    return _View(camera, keypoints.xy, flat, focal, to_flat, rank)


def _spread_order(x: Floats, size: tuple[int, int], seed: int) -> NDArray[np.int32]:
    """Order points so that any beginning of the order is spread over the image.

    The image is divided into cells. The order takes one random point of every cell, then a second
    one, and so on.

    Args:
        x: float64 [n, 2] points in pixels.
        size: (width, height) of the image.
        seed: seed of the random order within a cell.

    Returns:
        int32 [n] rank of each point in the order.
    """
    edge = math.sqrt(size[0] * size[1] / _NUM_CELLS)
    num_columns, num_rows = (math.ceil(length / edge) for length in size)
    column = np.clip(x[:, 0] / edge, 0, num_columns - 1).astype(np.uint16)
    row = np.clip(x[:, 1] / edge, 0, num_rows - 1).astype(np.uint16)
    order = np.random.default_rng(seed).permutation(len(x))
    # NumPy sorts 16-bit integers many times faster than longer ones.
    cell = (row * np.uint16(num_columns) + column)[order]
    by_cell = np.argsort(cell, kind="stable")
    sorted_cell = cell[by_cell]
    count = np.arange(len(x), dtype=np.int32)
    first = np.searchsorted(sorted_cell, sorted_cell)
    turn = np.empty(len(x), dtype=np.uint16)
    turn[by_cell] = np.minimum(count - first, np.iinfo(np.uint16).max)
    rank = np.empty(len(x), dtype=np.int32)
    rank[order[np.argsort(turn, kind="stable")]] = count
    return rank


def _verify_pair(
    a: _View,
    b: _View,
    matches: NDArray[np.uint32],
    search: Search,
) -> TwoViewGeometry:
    """Choose the model of one pair by the rules of COLMAP 4.2's EstimateTwoViewGeometry.

    COLMAP's watermark test is left out: it also flags slow pans of a wide view, and the mapper
    would then lose the pairs of neighbours that connect the tracks.
    """
    if len(matches) < max(search.options.min_num_inliers, MIN_MATCHES):
        return _degenerate()
    # The order is spread over the whole image, so its subset is spread over the matched part.
    ranks = a.rank.take(matches[:, 0])
    num_refined = min(len(matches), max(MAX_REFINED, search.options.max_samples))
    nearest = np.argpartition(ranks, num_refined - 1)[:num_refined]
    order = nearest[np.argsort(ranks[nearest])]
    if a.flat is not None and b.flat is not None:
        return _verify_calibrated(a, b, matches, order, search)
    return _verify_uncalibrated(a, b, matches, order, search)


def _degenerate() -> TwoViewGeometry:
    return TwoViewGeometry(TwoViewConfig.DEGENERATE, np.empty((0, 2), dtype=np.uint32))


def _verify_calibrated(
    a: _View, b: _View, matches: NDArray[np.uint32], order: Ints, search: Search
) -> TwoViewGeometry:
    """The geometry of a pair with known focal lengths."""
    options = search.options
    num_needed = options.min_num_inliers
    assert a.flat is not None
    assert b.flat is not None
    flat_a, flat_b = a.flat.take(matches[:, 0], axis=1), b.flat.take(matches[:, 1], axis=1)
    # Some pixels of a wide lens have no ray in front of the camera.
    order = order[np.isfinite(flat_a[0, order] + flat_b[0, order])]
    flat = spread_points(flat_a, flat_b, order)
    E = find_pose(flat, search, (a.focal, b.focal))

    # F cannot have more inliers than there are matches. If E has nearly that many, the pair is
    # calibrated and F is not needed.
    F = None
    num_F = 0
    if E.count < num_needed or E.count <= options.min_e_f_inlier_ratio * len(matches):
        F = find_fundamental(spread_points(*_pixels(a, b, matches), order), search)
        num_F = F.count

    calibrated = E.count >= num_needed and E.count > options.min_e_f_inlier_ratio * num_F
    rival = E if calibrated or F is None or num_F < num_needed else F
    # Distorted points of a plane are not related by a homography, so undistorted ones are used.
    H = find_homography(flat, search, rival.count)
    if calibrated:
        config = TwoViewConfig.CALIBRATED
        chosen = F if F is not None and num_F > E.count else E
    elif F is not None and num_F >= num_needed:
        config = TwoViewConfig.UNCALIBRATED
        chosen = F
    elif H.count >= num_needed:
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        chosen = H
    else:
        return _degenerate()
    if H.count > planar_share(options) * rival.count:
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if H.count > chosen.count:
            chosen = H

    # A pose is meaningless if a homography explains the matches as well.
    qvec = tvec = None
    if config == TwoViewConfig.CALIBRATED:
        qvec = np.asarray(E.pose.q, dtype=np.float64).reshape(4)
        # PoseLib's refinement does not keep the translation at exactly unit length.
        tvec = _unit(np.asarray(E.pose.t, dtype=np.float64).reshape(3))
    return TwoViewGeometry(
        config=config,
        inlier_matches=_inliers(matches, chosen),
        E=None if E.matrix is None else _on_rays(E.matrix, a, b),
        F=None if F is None else F.matrix,
        H=None if H.matrix is None else _unit(np.linalg.inv(b.to_flat) @ H.matrix @ a.to_flat),
        qvec=qvec,
        tvec=tvec,
    )


def _inliers(matches: NDArray[np.uint32], model: Model) -> NDArray[np.uint32]:
    """The inliers of a model; the same array if all matches are inliers."""
    chosen = matches if model.count == len(matches) else matches.compress(model.inliers, axis=0)
    return chosen.astype(np.uint32, copy=False)


def _pixels(a: _View, b: _View, matches: NDArray[np.uint32]) -> tuple[Floats, Floats]:
    """The matched keypoints of both images, float64 [2, n] each."""
    xa, xb = a.xy.take(matches[:, 0], axis=0), b.xy.take(matches[:, 1], axis=0)
    return np.ascontiguousarray(xa.T, np.float64), np.ascontiguousarray(xb.T, np.float64)


def _verify_uncalibrated(
    a: _View, b: _View, matches: NDArray[np.uint32], order: Ints, search: Search
) -> TwoViewGeometry:
    """The geometry of a pair without known focal lengths.

    If both images have the same camera, COLMAP 4.2 estimates a relative pose with a shared focal
    length. F has one more degree of freedom and is faster to estimate, with the same inliers.
    """
    options = search.options
    pixels = spread_points(*_pixels(a, b, matches), order)
    F = find_fundamental(pixels, search)
    shared = a.camera is b.camera
    H = find_homography(pixels, search, F.count)
    if max(F.count, H.count) < options.min_num_inliers:
        return _degenerate()
    config, chosen = TwoViewConfig.UNCALIBRATED, F
    if F.count < options.min_num_inliers or H.count > planar_share(options) * F.count:
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if shared or H.count >= F.count:
            chosen = H
    return TwoViewGeometry(
        config=config,
        inlier_matches=_inliers(matches, chosen),
        F=F.matrix,
        H=H.matrix,
    )


def _on_rays(E: Floats, a: _View, b: _View) -> Floats:
    """Convert the essential matrix of `find_pose` to normalised coordinates."""
    return _unit(E * np.outer([b.focal, b.focal, 1.0], [a.focal, a.focal, 1.0]))


def _unit(matrix: Floats) -> Floats:
    return np.asarray(matrix / np.linalg.norm(matrix))


def agreeing_matches(
    geometry: TwoViewGeometry,
    xa: NDArray[np.float32],
    xb: NDArray[np.float32],
    cameras: tuple[pycolmap.Camera, pycolmap.Camera],
    *,
    max_error: float,
) -> Bools:
    """Test which matches agree with the two-view geometry of their image pair.

    Args:
        geometry: the geometry, from the first image to the second.
        xa: float32 [n, 2] pixels in the first image.
        xb: float32 [n, 2] pixels in the second image.
        cameras: cameras of the first and the second image.
        max_error: largest Sampson (E, F) or transfer (H) error in pixels.

    Returns:
        bool [n]. If the pair is planar or panoramic, matches that agree with H count, too.
    """
    a, b = xa.T.astype(np.float64), xb.T.astype(np.float64)
    agrees = np.zeros(a.shape[1], dtype=np.bool_)
    # An uncalibrated pair may have an essential matrix, too, which explains too few matches.
    if geometry.E is not None and geometry.config != TwoViewConfig.UNCALIBRATED:
        focal = sum(camera.mean_focal_length() for camera in cameras) / 2
        rays = [
            np.asarray(camera.cam_from_img(x.T), dtype=np.float64).reshape(-1, 2).T
            for camera, x in zip(cameras, (a, b), strict=True)
        ]
        agrees |= epipolar_inliers(geometry.E, rays[0], rays[1], max_error / focal)
    elif geometry.F is not None:
        agrees |= epipolar_inliers(geometry.F, a, b, max_error)
    if geometry.H is not None and geometry.config in FLAT_CONFIGS:
        agrees |= transfer_inliers(geometry.H, a, b, max_error)
    return agrees
