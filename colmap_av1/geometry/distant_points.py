"""Compute points, including distant ones, of all tracks for training Gaussian splats."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from colmap_av1 import _core
from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.triangulation import (
    ERROR_TO_SIGMA,
    SIGMA_FLOOR,
    Observations,
    TriangulatedPoints,
    Views,
    triangulate,
)
from colmap_av1.options import TriangulateOptions
from colmap_av1.util.arrays import Bools, Floats, Ints

# Distances with a smaller relative uncertainty determine the depth of the scene.
_KNOWN = 0.3
# Distance of the far field: a multiple of this quantile of the known distances, or a multiple of
# the extent of the camera path, whichever is larger.
_NEARLY_ALL = 0.999
_FAR = 2.0
_FAR_EXTENTS = 10.0
# Distance of the far field if neither points nor the path determine it.
_ANY_FAR = 100.0
# A point is a floater if, in most of its images, it is nearer than this share of the distance of
# its surroundings, and fewer than _SUPPORT points there have the same distance within a factor.
_FLOATER_DISTANCE = 0.5
_NEAR_RATIO = 1.3
_SUPPORT = 4
# Width in pixels of the square around a point that is its surroundings, and the smallest number of
# points in it for a decision.
_SQUARE_WIDTH = 48.0
_FEWEST_IN_SQUARE = 8
# Lower bound on angles in radians, to avoid division by zero.
_TINY = 1e-12


@dataclass(frozen=True)
class _Seen:
    """The observations of the tracks, and the views."""

    observations: Observations
    views: Views
    centres: Floats

    def rays(self, rows: Ints) -> Floats:
        """Unit viewing directions in the world of some observations, float64 [n, 3]."""
        rays = np.column_stack([self.observations.rays[rows], np.ones(len(rows))])
        rotation = self.views.cam_from_world[self.observations.view[rows], :, :3]
        rays = np.einsum("nji,nj->ni", rotation, rays)
        return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))

    def origins(self, rows: Ints) -> Floats:
        """Camera centres of some observations, float64 [n, 3]."""
        return self.centres[self.observations.view[rows]]

    def of_points(self, points: TriangulatedPoints) -> dict[str, Any]:
        """Arguments of the core for points and the views that observe them."""
        return {
            "cam_from_world": np.ascontiguousarray(self.views.cam_from_world),
            "focal": np.ascontiguousarray(self.views.focal),
            "view": self.observations.view,
            "rays": self.observations.rays,
            "xyz": points.xyz,
            "offsets": points.offsets,
            "observation": points.observation,
        }

    def errors(self, points: TriangulatedPoints) -> Floats:
        """Reprojection errors in pixels of the points' observations; inf behind the camera."""
        return _core.reprojection_errors(**self.of_points(points))


def splat_points(
    observations: Observations,
    views: Views,
    options: TriangulateOptions,
    *,
    num_threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> TriangulatedPoints:
    """Compute points of all tracks that agree with the poses, whatever their parallax.

    Distant surfaces fill a large part of many images, and their exact distance matters little. A
    point with an uncertain distance stays on the ray of its middle image, and is moved towards the
    far field of the scene within its uncertainty. Tracks with parallel rays get a point in the far
    field. Floaters, which are much nearer than their surroundings in most images, are removed.

    Args:
        observations: the tracks.
        views: poses and focal lengths.
        options: only `max_reprojection_error` and `min_observations` apply.
        num_threads: number of threads; None: one per CPU. The result does not depend on it.
        progress: called with the number of tracks done so far.

    Returns:
        The points, in the order of the tracks.
    """
    anywhere = replace(
        options, points="survey", max_points=None, min_angle=0.0, max_depth_error=None
    )
    found = triangulate(observations, views, anywhere, num_threads=num_threads, progress=progress)
    seen = _Seen(observations, views, camera_centres(views.cam_from_world))
    unsure = distance_uncertainty(
        found.xyz,
        found.error,
        found.offsets,
        centres=seen.centres,
        view=observations.view[found.observation],
        focal=views.focal.mean(axis=1),
    )
    far = _far_distance(found, unsure, seen)
    points = _at_likely_distance(found, unsure, far, seen)
    far_away = _points_far_away(points, far, seen, options)
    points = _merged(points, far_away)
    points = points.take(np.flatnonzero(~_is_floater(points, seen)))
    return replace(points, num_agreeing=found.num_agreeing + len(far_away.xyz))


def distance_uncertainty(
    xyz: Floats,
    error: Floats,
    offsets: Ints,
    *,
    centres: Floats,
    view: Ints,
    focal: Floats,
) -> Floats:
    """Relative uncertainty of each point's distance from the cameras, float64 [n].

    Args:
        xyz: float64 [n, 3] the points.
        error: float64 [n] their mean reprojection errors in pixels.
        offsets: int64 [n + 1] offsets of the points' observations; each has at least one.
        centres: float64 [num_views, 3] camera centres.
        view: int64 [num_observations] view of each observation.
        focal: float64 [num_views] focal lengths in pixels.
    """
    angle = _core.widest_angles(
        centres=np.ascontiguousarray(centres), xyz=xyz, offsets=offsets, view=view
    )
    middle = view[(offsets[:-1] + offsets[1:]) // 2]
    sigma = np.hypot(SIGMA_FLOOR, ERROR_TO_SIGMA * error)
    return np.asarray(sigma / (focal[middle] * np.maximum(angle, _TINY)))


def _distance(points: TriangulatedPoints, seen: _Seen) -> Floats:
    """Distance of each point from the view of its middle observation."""
    return np.asarray(np.linalg.norm(points.xyz - seen.origins(points.middle), axis=1))


def _far_distance(points: TriangulatedPoints, unsure: Floats, seen: _Seen) -> float:
    """Assumed distance of the scene's far field."""
    extent = float(np.linalg.norm(seen.centres - seen.centres.mean(axis=0), axis=1).max())
    known = _distance(points, seen)[unsure < _KNOWN]
    deepest = float(np.quantile(known, _NEARLY_ALL)) if len(known) else 0.0
    return max(_FAR * deepest, _FAR_EXTENTS * extent) or _ANY_FAR


def _at_likely_distance(
    points: TriangulatedPoints, unsure: Floats, far: float, seen: _Seen
) -> TriangulatedPoints:
    """Move points along their middle ray towards the far field, within their uncertainty.

    The inverse distance is combined with a prior at the far field, whose standard deviation is the
    inverse of the median distance. Points beyond the far field move towards it as far as their
    uncertainty permits.
    """
    if len(points.xyz) == 0:
        return points
    distance = _distance(points, seen)
    usual = float(np.median(distance))
    pull = (unsure * usual / distance) ** 2
    drawn = (1.0 + pull) / (1.0 / distance + pull / far)
    within = np.maximum(far, distance / (1.0 + unsure))
    moved = np.where(distance > far, np.minimum(distance, within), np.minimum(drawn, far))
    # Changes below 0.1 % are ignored, so that well-determined points keep their optimal position.
    rows = np.flatnonzero(np.abs(moved / distance - 1.0) > 1e-3)
    middle = points.middle[rows]
    xyz = points.xyz.copy()
    xyz[rows] = seen.origins(middle) + seen.rays(middle) * moved[rows, None]
    return _with_errors(replace(points, xyz=xyz), seen)


def _with_errors(points: TriangulatedPoints, seen: _Seen) -> TriangulatedPoints:
    """The points with updated mean errors, without those behind one of their cameras."""
    if len(points.xyz) == 0:
        return points
    mean = np.add.reduceat(seen.errors(points), points.offsets[:-1]) / np.diff(points.offsets)
    return replace(points, error=mean).take(np.flatnonzero(np.isfinite(mean)))


def _points_far_away(
    points: TriangulatedPoints, far: float, seen: _Seen, options: TriangulateOptions
) -> TriangulatedPoints:
    """Far-field points of tracks without a point, if enough observations fit."""
    offsets = seen.observations.offsets
    track = np.searchsorted(offsets, points.observation[points.offsets[:-1]], side="right") - 1
    has_point = np.zeros(len(offsets) - 1, np.bool_)
    has_point[track] = True
    left = np.flatnonzero(~has_point & (np.diff(offsets) >= options.min_observations))
    tracks = replace(
        points,
        xyz=np.empty((len(offsets) - 1, 3)),
        error=np.empty(len(offsets) - 1),
        offsets=offsets,
        observation=np.arange(offsets[-1]),
    ).take(left)
    if len(left) == 0:
        return tracks
    middle = tracks.middle
    xyz = seen.origins(middle) + seen.rays(middle) * far
    kept = seen.errors(replace(tracks, xyz=xyz)) <= options.max_reprojection_error
    point = tracks.point[kept]
    counts = np.bincount(point, minlength=len(left))
    far_away = replace(
        points,
        xyz=xyz,
        error=np.zeros(len(left)),
        offsets=np.concatenate([[0], np.cumsum(counts)]),
        observation=tracks.observation[kept],
    ).take(np.flatnonzero(counts >= options.min_observations))
    return _with_errors(far_away, seen)


def _merged(one: TriangulatedPoints, two: TriangulatedPoints) -> TriangulatedPoints:
    """Merge points, in the order of their tracks."""
    both = replace(
        one,
        xyz=np.concatenate([one.xyz, two.xyz]),
        error=np.concatenate([one.error, two.error]),
        offsets=np.concatenate([one.offsets, two.offsets[1:] + one.offsets[-1]]),
        observation=np.concatenate([one.observation, two.observation]),
    )
    return both.take(np.argsort(both.observation[both.offsets[:-1]], kind="stable"))


def _is_floater(points: TriangulatedPoints, seen: _Seen) -> Bools:
    """Whether each point is a floater: nearly alone far in front of its surroundings."""
    votes = _core.floater_observations(
        **seen.of_points(points),
        distance_share=_FLOATER_DISTANCE,
        near_ratio=_NEAR_RATIO,
        support=_SUPPORT,
        square_width=_SQUARE_WIDTH,
        fewest_in_square=_FEWEST_IN_SQUARE,
    )
    return np.asarray(votes > 0.5 * np.diff(points.offsets))
