"""Estimate the models of an image pair: essential matrix, fundamental matrix and homography.

Nearly all matches of tracks are right. A linear fit, or a few iterations of PoseLib's robust
estimators, on some matches spread over the image is therefore enough to find a model. More matches
refine it, and all are tested against it. If few matches are right, the robust estimators run more
iterations.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import poselib

from colmap_av1.geometry.cameras import poselib_camera
from colmap_av1.matching.epipolar import (
    SMALLEST_GRADIENT,
    epipolar_inliers,
    epipolar_terms,
    essential_of_poses,
)
from colmap_av1.options import VerifyOptions
from colmap_av1.options.matching import MIN_MATCHES
from colmap_av1.util.arrays import Bools, Floats, Ints

# Fewest iterations of a robust estimator; it runs more if few matches are inliers.
_MIN_ITERATIONS = 15
# COLMAP limits the number of iterations to what this inlier ratio needs, times the factor.
_MIN_INLIER_RATIO = 0.25
_ITERATIONS_FACTOR = 3
# Numbers of matches that determine a model.
_POSE_SAMPLE, _FUNDAMENTAL_SAMPLE, _HOMOGRAPHY_SAMPLE = 5, 7, 4
# Number of matches on which a model is refined, and limits of the refinement.
MAX_REFINED = 500
_REFINEMENT = {"max_iterations": 8, "step_tol": 1e-4, "gradient_tol": 1e-6}
# Keeps denominators above 0 if points coincide or lie on a line.
_ROUNDING = 1e-12
_IDENTITY = np.eye(3)
# A model with this share of inliers is not searched again.
_TRUSTED_SHARE = 0.95
# As shares of the matches: RANSAC adds at most 10 % to the inliers of a quick fit, and rarely loses
# more than 4 %.
_RANSAC_GAIN, _RANSAC_LOSS = 0.1, 0.04
# COLMAP's homographies have this many times as many outliers as those found here. With this factor,
# the decision whether a pair is planar agrees best with COLMAP's on six real and rendered videos.
_COLMAP_OUTLIER_FACTOR = 1.08


@dataclass(frozen=True)
class Model:
    """A model and its inliers.

    Attributes:
        matrix: float64 [3, 3] in the coordinates the matches were tested in; None if no model was
            found.
        inliers: bool [n].
        count: number of inliers.
        pose: PoseLib's pose of an essential matrix.
    """

    matrix: Floats | None
    inliers: Bools
    count: int
    pose: Any = None


@dataclass(frozen=True)
class MatchedPoints:
    """Matched points of a pair, all in the same coordinates.

    Attributes:
        a: float64 [2, n] points in the first image.
        b: float64 [2, n] points in the second image.
        spread_a: float64 [2, k] a sample of `a` in an order that is spread over the image.
        spread_b: float64 [2, k] the matching points of `b`.
    """

    a: Floats
    b: Floats
    spread_a: Floats
    spread_b: Floats

    def first(self, count: int) -> tuple[Floats, Floats]:
        """The first matches of the sample, float64 [2, m] in each image."""
        return self.spread_a[:, :count], self.spread_b[:, :count]


def spread_points(a: Floats, b: Floats, order: Ints) -> MatchedPoints:
    """Select a sample of matched points.

    Args:
        a: float64 [2, n] points in the first image.
        b: float64 [2, n] points in the second image.
        order: int64 [k] indices of the sample, in an order that is spread over the image.
    """
    return MatchedPoints(a, b, a.take(order, axis=1), b.take(order, axis=1))


@dataclass(frozen=True)
class Search:
    """How the models of one pair are estimated.

    Attributes:
        options: thresholds and effort.
        seed: seed of the robust estimators.
    """

    options: VerifyOptions
    seed: int

    def part(self, share: float) -> int:
        """Number of matches in a share of the full sample."""
        return max(MIN_MATCHES, round(share * self.options.max_samples))

    def ransac(self, sample_size: int, inlier_ratio: float) -> dict[str, Any]:
        """The options in PoseLib's form.

        Args:
            sample_size: number of matches that determine the model.
            inlier_ratio: smallest inlier ratio of a model that is of use. It limits the number of
                iterations: pairs without a model would otherwise run all of them.
        """
        options = self.options
        clean = min(1.0, max(inlier_ratio, _MIN_INLIER_RATIO)) ** sample_size
        if options.confidence >= 1:
            wanted = options.max_iterations
        elif clean >= 1:
            wanted = _MIN_ITERATIONS
        else:
            trials = math.log(1 - options.confidence) / math.log(1 - clean)
            wanted = max(_MIN_ITERATIONS, math.ceil(_ITERATIONS_FACTOR * trials))
        return {
            "max_epipolar_error": options.max_error,
            "max_reproj_error": options.max_error,
            "max_iterations": min(wanted, options.max_iterations),
            "min_iterations": min(_MIN_ITERATIONS, options.max_iterations),
            "success_prob": options.confidence,
            "seed": self.seed,
        }

    def least_share(self, points: MatchedPoints) -> float:
        """Smallest share of inliers with which a pair is accepted."""
        return self.options.min_num_inliers / int(points.a.shape[1])


def find_pose(points: MatchedPoints, search: Search, focal_lengths: tuple[float, float]) -> Model:
    """Estimate the essential matrix, on undistorted pixels relative to the principal points.

    Args:
        points: the matches.
        search: how the model is estimated.
        focal_lengths: of the first and the second image, in pixels.
    """
    if points.spread_a.shape[1] < MIN_MATCHES:
        return _no_model(points)

    cameras = [poselib_camera(focal_length) for focal_length in focal_lengths]

    def refine(pose: Any, xa: Floats, xb: Floats) -> Model:
        pose, _ = poselib.refine_relative_pose(xa.T, xb.T, pose, *cameras, _REFINEMENT)
        tested = _test(epipolar_inliers, _essential(pose, *focal_lengths), points, search)
        return replace(tested, pose=pose)

    # A part of the sample is enough, because the result is refined on more matches.
    xa, xb = points.first(search.part(0.5))
    ransac = search.ransac(_POSE_SAMPLE, search.least_share(points))
    pose, _ = poselib.estimate_relative_pose(xa.T, xb.T, *cameras, ransac, {"max_iterations": 0})
    found = refine(pose, points.spread_a, points.spread_b)
    return _again_on_inliers(refine, found, found.pose, points, search)


def find_fundamental(points: MatchedPoints, search: Search) -> Model:
    """Estimate the fundamental matrix of a pair."""
    if points.spread_a.shape[1] < MIN_MATCHES:
        return _no_model(points)

    def refine(F: Floats, xa: Floats, xb: Floats) -> Model:
        F, _ = poselib.refine_fundamental(xa.T, xb.T, F, _REFINEMENT)
        return _test(epipolar_inliers, F, points, search)

    F = _linear_fundamental(*points.first(search.options.max_samples))
    quick = refine(F, points.spread_a, points.spread_b)
    if quick.count >= _TRUSTED_SHARE * points.a.shape[1]:
        return quick
    xa, xb = points.first(search.part(0.75))
    ransac = search.ransac(_FUNDAMENTAL_SAMPLE, search.least_share(points))
    F, _ = poselib.estimate_fundamental(xa.T, xb.T, ransac, {"max_iterations": 0})
    found = _test(epipolar_inliers, F, points, search)
    found = _again_on_inliers(refine, found, found.matrix, points, search)
    return min(found, quick, key=lambda model: _epipolar_loss(model, points))


def find_homography(points: MatchedPoints, search: Search, num_rival: int) -> Model:
    """Estimate the homography of a pair, as exactly as the choice between it and its rival needs.

    RANSAC is by far the most expensive step and rarely changes the choice, so it runs only if the
    number of inliers of a quick fit is close to the decisive number.

    Args:
        points: the matches.
        search: how the model is estimated.
        num_rival: number of inliers of the competing model.
    """
    if points.spread_a.shape[1] < MIN_MATCHES:
        return _no_model(points)
    num_matches = points.a.shape[1]
    xa, xb = points.first(search.options.max_samples)
    H = _affine_fit(xa, xb)
    # The first loss lets outliers pull less, the second ignores them.
    for loss, steps in (("CAUCHY", 2), ("TRUNCATED", 3)):
        robust = {
            **_REFINEMENT,
            "max_iterations": steps,
            "loss_type": loss,
            "loss_scale": search.options.max_error,
        }
        H, _ = poselib.refine_homography(xa.T, xb.T, H, robust)
    found = _test(transfer_inliers, H, points, search)
    decisive = planar_share(search.options) * num_rival / num_matches
    if not -_RANSAC_GAIN < found.count / num_matches - decisive < _RANSAC_LOSS:
        return found
    ransac = search.ransac(_HOMOGRAPHY_SAMPLE, decisive)
    H, _ = poselib.estimate_homography(xa.T, xb.T, ransac, _REFINEMENT)
    return _test(transfer_inliers, H, points, search)


def planar_share(options: VerifyOptions) -> float:
    """Share of the rival's inliers that makes a pair planar, adjusted to agree with COLMAP."""
    return 1 - (1 - options.max_h_inlier_ratio) / _COLMAP_OUTLIER_FACTOR


def _again_on_inliers(
    refine: Callable[[Any, Floats, Floats], Model],
    found: Model,
    start: Any,
    points: MatchedPoints,
    search: Search,
) -> Model:
    """Refine a model with many outliers once more, on its inliers.

    Args:
        refine: refines a model with matches [2, n] of both images.
        found: the model.
        start: what `refine` starts from, PoseLib's pose or a matrix.
        points: the matches.
        search: the options of the search.
    """
    if found.matrix is None or found.count >= _TRUSTED_SHARE * points.a.shape[1]:
        return found
    agree = epipolar_inliers(
        found.matrix, points.spread_a, points.spread_b, search.options.max_error
    )
    if np.count_nonzero(agree) < MIN_MATCHES:
        return found
    again = refine(start, points.spread_a[:, agree], points.spread_b[:, agree])
    return min(found, again, key=lambda model: _epipolar_loss(model, points))


def _epipolar_loss(model: Model, points: MatchedPoints) -> float:
    """The loss that refinement minimizes; it also ranks models with the same inliers."""
    if model.matrix is None:
        return math.inf
    algebraic, gradient = epipolar_terms(model.matrix, points.spread_a, points.spread_b)
    squared = algebraic**2 / np.maximum(gradient, SMALLEST_GRADIENT)
    return float(np.log1p(squared).sum())


def _essential(pose: Any, focal_a: float, focal_b: float) -> Floats:
    """The essential matrix of a pose, on undistorted pixels relative to the principal points."""
    E = essential_of_poses(np.eye(3, 4), np.asarray(pose.Rt))
    return np.asarray(E / np.outer([focal_b, focal_b, 1.0], [focal_a, focal_a, 1.0]))


def _linear_fundamental(xa: Floats, xb: Floats) -> Floats:
    """Fit the fundamental matrix by least squares (Hartley and Zisserman, 11.1 and 11.4).

    A second fit weights each match for its Sampson error, and reduces the weight of errors above a
    pixel.
    """
    a, to_a = _normalised(xa)
    b, to_b = _normalised(xb)
    rows = (b[:, None] * a).reshape(9, -1)
    F = np.linalg.eigh(rows @ rows.T)[1][:, 0].reshape(3, 3)
    algebraic, gradient = epipolar_terms(F, a[:2], b[:2])
    weight = 1 / (gradient + (algebraic / to_b[0, 0]) ** 2 + _ROUNDING)
    F = np.linalg.eigh((rows * weight) @ rows.T)[1][:, 0].reshape(3, 3)
    # The rank is not enforced here: refinement starts from the nearest matrix of rank two.
    return np.asarray(to_b.T @ F @ to_a)


def _normalised(x: Floats) -> tuple[Floats, Floats]:
    """Normalise points [2, n]; return them homogeneous, with the normalising matrix [3, 3]."""
    centre = x.sum(axis=1) / x.shape[1]
    moved = x - centre[:, None]
    scale = 1 / (math.sqrt(np.vdot(moved, moved) / x.size) + _ROUNDING)
    transform = np.array(
        [[scale, 0.0, -scale * centre[0]], [0.0, scale, -scale * centre[1]], [0.0, 0.0, 1.0]]
    )
    return _homogeneous(moved * scale), transform


def _homogeneous(x: Floats) -> Floats:
    """Append a third coordinate 1 to points [2, n], giving [3, n]."""
    extended = np.ones((3, x.shape[1]))
    extended[:2] = x
    return extended


def _affine_fit(xa: Floats, xb: Floats) -> Floats:
    """Fit the affine map from `xa` to `xb` by least squares, as a 3x3 matrix."""
    a = _homogeneous(xa)
    square = a @ a.T
    # Regularized, so that points on a line have a solution.
    square += _ROUNDING * np.trace(square) * _IDENTITY
    return np.vstack([np.linalg.solve(square, a @ xb.T).T, _IDENTITY[2]])


def _no_model(points: MatchedPoints) -> Model:
    return Model(None, np.zeros(points.a.shape[1], dtype=bool), 0)


def _test(
    inliers_of: Callable[..., Bools], matrix: Any, points: MatchedPoints, search: Search
) -> Model:
    """Scale a matrix to unit norm and find its inliers; no model unless it is finite and not 0."""
    matrix = np.asarray(matrix, dtype=np.float64)
    norm = float(np.linalg.norm(matrix))
    if not (math.isfinite(norm) and norm > 0):
        return _no_model(points)
    matrix = matrix / norm
    inliers = inliers_of(matrix, points.a, points.b, search.options.max_error)
    return Model(matrix, inliers, int(np.count_nonzero(inliers)))


def transfer_inliers(H: Floats, xa: Floats, xb: Floats, max_error: float) -> Bools:
    """Matches that H maps to within `max_error` of their position in the second image."""
    mapped = H[:, :2] @ xa + H[:, 2:]
    # Multiplied by the third coordinate, so that points at infinity cause no division by zero.
    x = mapped[0] - xb[0] * mapped[2]
    y = mapped[1] - xb[1] * mapped[2]
    return np.asarray(x**2 + y**2 <= (max_error * mapped[2]) ** 2)
