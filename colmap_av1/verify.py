"""Two-view geometry of image pairs: which matches agree with a rigid scene, and how.

The models start from a sample of the matches that is spread over the image; more matches
refine them and all are tested against them. The decisions between the models and all thresholds
are those of COLMAP 4.2's own geometric verification (`TwoViewGeometryOptions`), so a database
filled here and one filled by COLMAP's matchers mean the same. Nearly all matches of tracks are
right, so a linear fit or few iterations of PoseLib's robust estimators are enough to find a
model; where few are, the robust estimators go on by themselves.
"""

from __future__ import annotations

import math
import os
import zlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import IntEnum
from typing import Any

import numpy as np
import poselib
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import OptionError
from colmap_av1.options import VerifyOptions
from colmap_av1.pairs import ImageKeypoints

_Floats = NDArray[np.float64]


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
    E: _Floats | None = None
    F: _Floats | None = None
    H: _Floats | None = None
    qvec: _Floats | None = None
    tvec: _Floats | None = None


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
    a homography explains nearly as many, PLANAR_OR_PANORAMIC; with too few inliers DEGENERATE.

    Args:
        keypoints: the images' keypoints.
        pairs: int32 [m, 2] indices into `keypoints`.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
        cameras: the camera of all images, or one for each; images share a camera where theirs
            are the same object.
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
    views: dict[int, _View] = {}  # from the first pair that needs one to the last
    last_pair = {int(image): index for index, pair in enumerate(pairs) for image in pair}

    def view(image: int) -> _View:
        found = views.get(image)
        if found is None:
            # Where two threads make it at a time, both make the same.
            seed = _seed(options.seed, image)
            found = views[image] = _view(keypoints[image], cameras[image], seed)
        return found

    def verify(index: int) -> TwoViewGeometry:
        i, j = (int(k) for k in pairs[index])
        return _verify_pair(view(i), view(j), matches[index], (i, j), options)

    geometries: list[TwoViewGeometry] = []
    num_threads = options.num_threads if options.num_threads is not None else _num_cpus()
    # PoseLib and NumPy's loops release the interpreter lock, so threads are enough.
    with ThreadPoolExecutor(max_workers=num_threads) as executor:
        try:
            for geometry in executor.map(verify, range(len(pairs))):
                for image in pairs[len(geometries)].tolist():
                    if last_pair[image] == len(geometries):
                        views.pop(image, None)
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
        camera: the image's camera.
        xy: float32 [n, 2] keypoints.
        flat: float64 [2, n] undistorted keypoints in pixels from the principal point; None
            without a focal length prior.
        focal: mean focal length in pixels.
        to_flat: float64 [3, 3] takes pixels without distortion to `flat`.
        pinhole: the camera of `flat`, in PoseLib's words.
        place: int32 [n] place of each keypoint in an order that is spread over the image from
            its beginning on.
    """

    camera: pycolmap.Camera
    xy: NDArray[np.float32]
    flat: _Floats | None
    focal: float
    to_flat: _Floats
    pinhole: dict[str, Any]
    place: NDArray[np.int32]


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
    pinhole = {
        "model": "SIMPLE_PINHOLE",
        "width": width,
        "height": height,
        "params": [focal, 0.0, 0.0],
    }
    place = _spread_order(pixels, (width, height), seed)
    to_flat = np.diag([focal, focal, 1.0]) @ np.linalg.inv(camera.calibration_matrix())
    return _View(camera, keypoints.xy, flat, focal, to_flat, pinhole, place)


def _spread_order(x: _Floats, size: tuple[int, int], seed: int) -> NDArray[np.int32]:
    """Order points so that any beginning of the order is spread over the image.

    The image is divided into cells; every cell gives one random point before any gives its
    second, and so on.

    Args:
        x: float64 [n, 2] points in pixels.
        size: (width, height) of the image.
        seed: seed of the random order within a cell.

    Returns:
        int32 [n] place of each point in the order.
    """
    edge = math.sqrt(size[0] * size[1] / _NUM_CELLS)
    num_columns, num_rows = (math.ceil(length / edge) for length in size)
    column = np.clip(x[:, 0] / edge, 0, num_columns - 1).astype(np.uint16)
    row = np.clip(x[:, 1] / edge, 0, num_rows - 1).astype(np.uint16)
    order = np.random.default_rng(seed).permutation(len(x))
    # NumPy sorts numbers of 16 bits many times as fast as longer ones.
    cell = (row * np.uint16(num_columns) + column)[order]
    by_cell = np.argsort(cell, kind="stable")
    sorted_cell = cell[by_cell]
    count = np.arange(len(x), dtype=np.int32)
    first = np.searchsorted(sorted_cell, sorted_cell)
    turn = np.empty(len(x), dtype=np.uint16)
    turn[by_cell] = np.minimum(count - first, np.iinfo(np.uint16).max)
    place = np.empty(len(x), dtype=np.int32)
    place[order[np.argsort(turn, kind="stable")]] = count
    return place


@dataclass(frozen=True)
class _Model:
    """A model and the matches that agree with it.

    Attributes:
        matrix: float64 [3, 3] in the coordinates the matches were tested in; None where none
            was found.
        inliers: bool [n].
        count: number of inliers.
        pose: PoseLib's pose of an essential matrix.
    """

    matrix: _Floats | None
    inliers: NDArray[np.bool_]
    count: int
    pose: Any = None


def _verify_pair(
    a: _View,
    b: _View,
    matches: NDArray[np.uint32],
    pair: tuple[int, int],
    options: VerifyOptions,
) -> TwoViewGeometry:
    """Choose the model of one pair as COLMAP 4.2 does (EstimateTwoViewGeometry's rules).

    Its test for watermarks is left out: the matches of a wide picture that pans slowly pass
    it, and the mapper would lose the pairs of neighbours that tracks are made of.
    """
    if len(matches) < max(options.min_num_inliers, _MIN_MATCHES):
        return _degenerate()
    # A beginning of the order that was made for the whole image stays spread in its part.
    places = a.place.take(matches[:, 0])
    num_refined = min(len(matches), max(_MAX_REFINED, options.max_samples))
    nearest = np.argpartition(places, num_refined - 1)[:num_refined]
    order = nearest[np.argsort(places[nearest])]
    search = _Search(options, _seed(options.seed, *pair))
    if a.flat is not None and b.flat is not None:
        return _verify_calibrated(a, b, matches, order, search)
    return _verify_uncalibrated(a, b, matches, order, search)


@dataclass(frozen=True)
class _Points:
    """Matched points of a pair, all in the same coordinates.

    Attributes:
        a: float64 [2, n] those in the first image.
        b: float64 [2, n] those in the second image.
        spread_a: float64 [2, k] the first of an order that is spread over the image.
        spread_b: float64 [2, k] likewise.
    """

    a: _Floats
    b: _Floats
    spread_a: _Floats
    spread_b: _Floats

    def first(self, count: int) -> tuple[_Floats, _Floats]:
        """The first matches of the spread order, float64 [2, m] in either image."""
        return self.spread_a[:, :count], self.spread_b[:, :count]


def _points(a: _Floats, b: _Floats, order: NDArray[np.int64]) -> _Points:
    return _Points(a, b, a.take(order, axis=1), b.take(order, axis=1))


@dataclass(frozen=True)
class _Search:
    """How the models of one pair are looked for.

    Attributes:
        options: thresholds and effort.
        seed: seed of the robust estimators.
    """

    options: VerifyOptions
    seed: int

    def part(self, share: float) -> int:
        """Number of matches in a share of a full sample."""
        return max(_MIN_MATCHES, round(share * self.options.max_samples))

    def ransac(self, min_iterations: int) -> dict[str, Any]:
        """PoseLib's words for it."""
        return {
            "max_epipolar_error": self.options.max_error,
            "max_reproj_error": self.options.max_error,
            "max_iterations": self.options.max_iterations,
            "min_iterations": min(min_iterations, self.options.max_iterations),
            "success_prob": self.options.confidence,
            "seed": self.seed,
        }


# Cells of an image that one point each is taken from before any gives its second.
_NUM_CELLS = 128
# A fundamental matrix takes seven matches; an eighth is the first that can disagree.
_MIN_MATCHES = 8
# Iterations of a robust estimator at least; more follow where few matches agree.
_MIN_ITERATIONS = 15
# Share of inliers below which COLMAP spends no more iterations on a model.
_MIN_INLIER_RATIO = 0.25
# Matches a model is refined on, and steps of refinement.
_MAX_REFINED = 500
_REFINEMENT = {"max_iterations": 8, "step_tol": 1e-4, "gradient_tol": 1e-6}
# What keeps sums of points that coincide or lie on a line apart from 0.
_ROUNDING = 1e-12
_IDENTITY = np.eye(3)
# A model with this share of the matches is not searched any longer.
_TRUSTED_SHARE = 0.95
# A search finds no more inliers than a quick fit by this share of the matches, and hardly ever
# less by that one.
_SEARCH_GAINS, _SEARCH_LOSES = 0.1, 0.04
# COLMAP's homographies leave out this many times as many matches as those that are found here:
# with it, pairs of six real and rendered videos are planar or not as COLMAP says most often.
_COLMAP_LEAVES_OUT = 1.08


def _degenerate() -> TwoViewGeometry:
    return TwoViewGeometry(TwoViewConfig.DEGENERATE, np.empty((0, 2), dtype=np.uint32))


def _seed(*words: int) -> int:
    return zlib.crc32(repr(words).encode())


def _verify_calibrated(
    a: _View, b: _View, matches: NDArray[np.uint32], order: NDArray[np.int64], search: _Search
) -> TwoViewGeometry:
    """The geometry of a pair whose focal lengths are known."""
    options = search.options
    num_needed = options.min_num_inliers
    assert a.flat is not None
    assert b.flat is not None
    flat_a, flat_b = a.flat.take(matches[:, 0], axis=1), b.flat.take(matches[:, 1], axis=1)
    # Some pixels of a wide lens have no ray in front of the camera.
    order = order[np.isfinite(flat_a[0, order] + flat_b[0, order])]
    flat = _points(flat_a, flat_b, order)
    E = _find_pose(a, b, flat, search)

    # F cannot have more inliers than there are matches: where E comes that close, the pair
    # is calibrated whatever F says.
    F = None
    num_F = 0
    if E.count < num_needed or E.count <= options.min_e_f_inlier_ratio * len(matches):
        F = _find_fundamental(_points(*_pixels(a, b, matches), order), search)
        num_F = F.count

    calibrated = E.count >= num_needed and E.count > options.min_e_f_inlier_ratio * num_F
    rival = E if calibrated or F is None or num_F < num_needed else F
    # A plane maps to a plane without distortion only.
    H = _find_homography(flat, search, rival.count)
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
    if H.count > _planar_share(options) * rival.count:
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if H.count > chosen.count:
            chosen = H

    # A pose means nothing where a homography explains the matches as well.
    qvec = tvec = None
    if config == TwoViewConfig.CALIBRATED:
        qvec = np.asarray(E.pose.q, dtype=np.float64).reshape(4)
        # PoseLib's steps along the sphere of directions leave it a little.
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


def _inliers(matches: NDArray[np.uint32], model: _Model) -> NDArray[np.uint32]:
    """The matches that agree with a model; the same object where all do."""
    chosen = matches if model.count == len(matches) else matches.compress(model.inliers, axis=0)
    return chosen.astype(np.uint32, copy=False)


def _pixels(a: _View, b: _View, matches: NDArray[np.uint32]) -> tuple[_Floats, _Floats]:
    """The matched keypoints of both images, float64 [2, n] each."""
    xa, xb = a.xy.take(matches[:, 0], axis=0), b.xy.take(matches[:, 1], axis=0)
    return np.ascontiguousarray(xa.T, np.float64), np.ascontiguousarray(xb.T, np.float64)


def _verify_uncalibrated(
    a: _View, b: _View, matches: NDArray[np.uint32], order: NDArray[np.int64], search: _Search
) -> TwoViewGeometry:
    """The geometry of a pair without known focal lengths.

    Where both images have the same camera, COLMAP 4.2 looks for a relative pose with a shared
    focal length. F has one degree of freedom more and is found in less time; what agrees with
    one agrees with the other.
    """
    options = search.options
    pixels = _points(*_pixels(a, b, matches), order)
    F = _find_fundamental(pixels, search)
    shared = a.camera is b.camera
    H = _find_homography(pixels, search, F.count)
    if max(F.count, H.count) < options.min_num_inliers:
        return _degenerate()
    config, chosen = TwoViewConfig.UNCALIBRATED, F
    if F.count < options.min_num_inliers or H.count > _planar_share(options) * F.count:
        config = TwoViewConfig.PLANAR_OR_PANORAMIC
        if shared or H.count >= F.count:
            chosen = H
    return TwoViewGeometry(
        config=config,
        inlier_matches=_inliers(matches, chosen),
        F=F.matrix,
        H=H.matrix,
    )


def _planar_share(options: VerifyOptions) -> float:
    """Share of the rival's inliers that a homography found here needs, to decide as COLMAP does."""
    return 1 - (1 - options.max_h_inlier_ratio) / _COLMAP_LEAVES_OUT


def _find_pose(a: _View, b: _View, points: _Points, search: _Search) -> _Model:
    """The essential matrix of a pair, on undistorted pixels from the principal points."""
    if points.spread_a.shape[1] < _MIN_MATCHES:
        return _no_model(points)

    def refine(pose: Any, xa: _Floats, xb: _Floats) -> _Model:
        pose, _ = poselib.refine_relative_pose(xa.T, xb.T, pose, a.pinhole, b.pinhole, _REFINEMENT)
        tested = _test(_epipolar_inliers, _on_flat(pose, a, b), points, search)
        return replace(tested, pose=pose)

    # A part of the sample is enough: what is found is refined on more than all of it.
    xa, xb = points.first(search.part(0.5))
    pose, _ = poselib.estimate_relative_pose(
        xa.T, xb.T, a.pinhole, b.pinhole, search.ransac(_MIN_ITERATIONS), {"max_iterations": 0}
    )
    found = refine(pose, points.spread_a, points.spread_b)
    return _again_on_inliers(refine, found, found.pose, points, search)


def _again_on_inliers(
    refine: Callable[[Any, _Floats, _Floats], _Model],
    found: _Model,
    model: Any,
    points: _Points,
    search: _Search,
) -> _Model:
    """Refine a model that leaves out many matches once more, without those."""
    if found.matrix is None or found.count >= _TRUSTED_SHARE * points.a.shape[1]:
        return found
    agree = _epipolar_inliers(
        found.matrix, points.spread_a, points.spread_b, search.options.max_error
    )
    if np.count_nonzero(agree) < _MIN_MATCHES:
        return found
    again = refine(model, points.spread_a[:, agree], points.spread_b[:, agree])
    return min(found, again, key=lambda model: _epipolar_loss(model, points))


def _epipolar_loss(model: _Model, points: _Points) -> float:
    """The loss that refinement lowers: it tells models apart that have the same inliers."""
    if model.matrix is None:
        return math.inf
    algebraic, gradient = _epipolar_terms(model.matrix, points.spread_a, points.spread_b)
    squared = algebraic**2 / np.maximum(gradient, np.finfo(np.float64).tiny)
    return float(np.log1p(squared).sum())


def _on_flat(pose: Any, a: _View, b: _View) -> _Floats:
    """The essential matrix of a pose, for coordinates that are `flat` in a view."""
    R, t = np.asarray(pose.R), np.asarray(pose.t).reshape(3)
    E = np.array([[0.0, -t[2], t[1]], [t[2], 0.0, -t[0]], [-t[1], t[0], 0.0]]) @ R
    return np.asarray(E / np.outer([b.focal, b.focal, 1.0], [a.focal, a.focal, 1.0]))


def _find_fundamental(points: _Points, search: _Search) -> _Model:
    """The fundamental matrix of a pair."""
    if points.spread_a.shape[1] < _MIN_MATCHES:
        return _no_model(points)

    def refine(F: _Floats, xa: _Floats, xb: _Floats) -> _Model:
        F, _ = poselib.refine_fundamental(xa.T, xb.T, F, _REFINEMENT)
        return _test(_epipolar_inliers, F, points, search)

    F = _linear_fundamental(*points.first(search.options.max_samples))
    quick = refine(F, points.spread_a, points.spread_b)
    if quick.count >= _TRUSTED_SHARE * points.a.shape[1]:
        return quick
    xa, xb = points.first(search.part(0.75))
    F, _ = poselib.estimate_fundamental(
        xa.T, xb.T, search.ransac(_MIN_ITERATIONS), {"max_iterations": 0}
    )
    found = _test(_epipolar_inliers, F, points, search)
    found = _again_on_inliers(refine, found, found.matrix, points, search)
    return min(found, quick, key=lambda model: _epipolar_loss(model, points))


def _linear_fundamental(xa: _Floats, xb: _Floats) -> _Floats:
    """The fundamental matrix with least squares (Hartley and Zisserman, 11.1 and 11.4).

    A second solution gives every match the weight of its Sampson error, and less where that is
    above a pixel.
    """
    a, to_a = _normalised(xa)
    b, to_b = _normalised(xb)
    rows = (b[:, None] * a).reshape(9, -1)
    F = np.linalg.eigh(rows @ rows.T)[1][:, 0].reshape(3, 3)
    algebraic, gradient = _epipolar_terms(F, a[:2], b[:2])
    weight = 1 / (gradient + (algebraic / to_b[0, 0]) ** 2 + _ROUNDING)
    F = np.linalg.eigh((rows * weight) @ rows.T)[1][:, 0].reshape(3, 3)
    # Refinement takes the nearest matrix of rank two.
    return np.asarray(to_b.T @ F @ to_a)


def _normalised(x: _Floats) -> tuple[_Floats, _Floats]:
    """Points [2, n] as homogeneous ones about 0 of size 1, and what makes them so, [3, 3]."""
    centre = x.sum(axis=1) / x.shape[1]
    moved = x - centre[:, None]
    scale = 1 / (math.sqrt(np.vdot(moved, moved) / x.size) + _ROUNDING)
    transform = np.array(
        [[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]]
    )
    return _homogeneous(moved * scale), transform


def _homogeneous(x: _Floats) -> _Floats:
    """Points [2, n] with a third coordinate 1, [3, n]."""
    extended = np.ones((3, x.shape[1]))
    extended[:2] = x
    return extended


def _find_homography(points: _Points, search: _Search, num_rival: int) -> _Model:
    """The homography of a pair, as well as the decision between it and its rival needs it.

    A search until no better one is found is the costliest part of all and seldom decides: a
    quick fit shows whether the inliers come near the rival's.

    Args:
        points: the matches.
        search: how to look for it.
        num_rival: inliers of the model it competes with.
    """
    if points.spread_a.shape[1] < _MIN_MATCHES:
        return _no_model(points)
    num_matches = points.a.shape[1]
    xa, xb = points.first(search.options.max_samples)
    H = _affine_fit(xa, xb)
    # The first loss brings matches near that are to agree, the second drops all others.
    for loss, steps in (("CAUCHY", 2), ("TRUNCATED", 3)):
        robust = {
            **_REFINEMENT,
            "max_iterations": steps,
            "loss_type": loss,
            "loss_scale": search.options.max_error,
        }
        H, _ = poselib.refine_homography(xa.T, xb.T, H, robust)
    found = _test(_transfer_inliers, H, points, search)
    decisive = _planar_share(search.options) * num_rival / num_matches
    if not -_SEARCH_GAINS < found.count / num_matches - decisive < _SEARCH_LOSES:
        return found
    ransac = search.ransac(_MIN_ITERATIONS)
    ransac["max_iterations"] = _num_iterations(decisive, search.options)
    H, _ = poselib.estimate_homography(xa.T, xb.T, ransac, _REFINEMENT)
    return _test(_transfer_inliers, H, points, search)


def _num_iterations(inlier_ratio: float, options: VerifyOptions) -> int:
    """Iterations after which a homography with this share of inliers is found or absent.

    COLMAP searches no longer either, so a close case ends alike.
    """
    clean = max(inlier_ratio, _MIN_INLIER_RATIO) ** 4
    if clean >= 1 or options.confidence >= 1:
        wanted = options.max_iterations if options.confidence >= 1 else 1
    else:
        wanted = math.ceil(3 * math.log(1 - options.confidence) / math.log(1 - clean))
    return min(max(wanted, _MIN_ITERATIONS), options.max_iterations)


def _affine_fit(xa: _Floats, xb: _Floats) -> _Floats:
    """The affine map, as a 3x3 matrix, that takes `xa` to `xb` with the least squares."""
    a = _homogeneous(xa)
    square = a @ a.T
    # A little more than that, so points on a line have a solution.
    square += _ROUNDING * np.trace(square) * _IDENTITY
    return np.vstack([np.linalg.solve(square, a @ xb.T).T, _IDENTITY[2]])


def _no_model(points: _Points) -> _Model:
    return _Model(None, np.zeros(points.a.shape[1], dtype=bool), 0)


def _test(
    inliers_of: Callable[..., NDArray[np.bool_]], matrix: Any, points: _Points, search: _Search
) -> _Model:
    """The matrix at unit norm with its inliers; no model where an estimator found none."""
    matrix = np.asarray(matrix, dtype=np.float64)
    norm = float(np.linalg.norm(matrix))
    if not (math.isfinite(norm) and norm > 0):
        return _no_model(points)
    matrix = matrix / norm
    inliers = inliers_of(matrix, points.a, points.b, search.options.max_error)
    return _Model(matrix, inliers, int(np.count_nonzero(inliers)))


def _epipolar_inliers(F: _Floats, xa: _Floats, xb: _Floats, max_error: float) -> NDArray[np.bool_]:
    """Matches whose Sampson error (Hartley and Zisserman, eq. 11.9) is within `max_error`."""
    algebraic, gradient = _epipolar_terms(F, xa, xb)
    return np.asarray(algebraic**2 <= max_error**2 * gradient)


def _epipolar_terms(F: _Floats, xa: _Floats, xb: _Floats) -> tuple[_Floats, _Floats]:
    """Algebraic error of matches [2, n], and the square of its gradient, float64 [n] each."""
    lines_b = F[:, :2] @ xa + F[:, 2:]
    lines_a = F.T[:2, :2] @ xb + F.T[:2, 2:]
    algebraic = xb[0] * lines_b[0] + xb[1] * lines_b[1] + lines_b[2]
    gradient = lines_b[0] ** 2 + lines_b[1] ** 2 + lines_a[0] ** 2 + lines_a[1] ** 2
    return algebraic, gradient


def _transfer_inliers(H: _Floats, xa: _Floats, xb: _Floats, max_error: float) -> NDArray[np.bool_]:
    """Matches that H maps to within `max_error` of their place in the second image."""
    mapped = H[:, :2] @ xa + H[:, 2:]
    # Multiplied out by the third coordinate, so no point at infinity divides by zero.
    x = mapped[0] - xb[0] * mapped[2]
    y = mapped[1] - xb[1] * mapped[2]
    return np.asarray(x**2 + y**2 <= (max_error * mapped[2]) ** 2)


def _on_rays(E: _Floats, a: _View, b: _View) -> _Floats:
    """The essential matrix of normalised coordinates from `_find_pose`'s."""
    return _unit(E * np.outer([b.focal, b.focal, 1.0], [a.focal, a.focal, 1.0]))


def _unit(matrix: _Floats) -> _Floats:
    return np.asarray(matrix / np.linalg.norm(matrix))


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
