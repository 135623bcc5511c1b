"""Robust triangulation of all tracks on known poses."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.options import TriangulateOptions
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.util.grouping import take_rows
from colmap_av1.util.threads import map_on_threads

# Result of the core for a range of tracks, see `TriangulatedPoints`.
_Part = tuple[Floats, Floats, Ints, Ints, int, int]

# Number of observations in a unit of work, small enough to report progress and use all threads.
_CHUNK = 65_536
# Lower bound on the expected error of an observation, in pixels.
SIGMA_FLOOR = 0.3
# Assumed ratio of the error of a ray to the mean reprojection error of its point, for estimating
# the uncertainty of the depth.
ERROR_TO_SIGMA = 2.0


@dataclass(frozen=True)
class Views:
    """Images with known poses.

    Attributes:
        cam_from_world: float64 [n, 3, 4] poses, x_cam = R x_world + t.
        focal: float64 [n, 2] focal lengths along x and y, which convert errors to pixels.
    """

    cam_from_world: Floats
    focal: Floats


@dataclass(frozen=True)
class Observations:
    """Observations of tracks by views, in compressed sparse row form.

    Attributes:
        offsets: int64 [num_tracks + 1]; track t has offsets[t] : offsets[t + 1], by time.
        view: int64 [num_observations] index of the view.
        rays: float64 [num_observations, 2] undistorted position (x / z, y / z) in the camera;
            observations that are not finite are ignored.
        sigma: float32 [num_observations] expected error in pixels.
    """

    offsets: Ints
    view: Ints
    rays: Floats
    sigma: NDArray[np.float32]


@dataclass(frozen=True)
class TriangulatedPoints:
    """Triangulated points, in compressed sparse row form.

    Point p has the observations observation[offsets[p] : offsets[p + 1]].

    Attributes:
        xyz: float64 [num_points, 3] in the world of the poses.
        error: float64 [num_points] mean reprojection error in pixels.
        offsets: int64 [num_points + 1].
        observation: int64 indices into the observations that were triangulated.
        num_agreeing: number of tracks of which enough observations agree with the poses,
            including those without sufficient parallax for a point.
        num_tracks: number of tracks with enough observations.
    """

    xyz: Floats
    error: Floats
    offsets: Ints
    observation: Ints
    num_agreeing: int
    num_tracks: int

    @property
    def point(self) -> Ints:
        """Index of the point of each observation: int64 [num_observations]."""
        return np.repeat(np.arange(len(self.xyz)), np.diff(self.offsets))

    @property
    def middle(self) -> Ints:
        """The middle observation of each point: int64 [num_points]."""
        return np.asarray(self.observation[(self.offsets[:-1] + self.offsets[1:]) // 2])

    def take(self, rows: Ints) -> TriangulatedPoints:
        """Select points, in the order of `rows`."""
        offsets, seen = take_rows(self.offsets, rows)
        return replace(
            self,
            xyz=self.xyz[rows],
            error=self.error[rows],
            offsets=offsets,
            observation=self.observation[seen],
        )


def triangulate(
    observations: Observations,
    views: Views,
    options: TriangulateOptions = TriangulateOptions(),
    *,
    num_threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> TriangulatedPoints:
    """Triangulate tracks on known poses.

    A point is initialized with the midpoint of two rays (Hartley and Sturm, "Triangulation", 1997)
    that fits all observations best among several candidates. Gauss-Newton steps then minimize the
    reprojection error, with a robust weight and the expected error of each observation.
    Observations beyond `max_reprojection_error` or behind the camera are dropped. Because a track
    may have slid from one surface to another, the dropped observations are triangulated once more
    as a separate point. A point whose rays have error e and triangulation angle a has a relative
    depth error of e / a; points beyond `max_depth_error` are rejected.

    Args:
        observations: the tracks.
        views: poses and focal lengths.
        options: criteria for points.
        num_threads: number of threads; None: one per CPU. The result does not depend on it.
        progress: called with the number of tracks done so far.

    Returns:
        The points, in the order of the tracks.
    """
    offsets = observations.offsets
    cam_from_world = np.ascontiguousarray(views.cam_from_world)
    focal = np.ascontiguousarray(views.focal)
    chunk = np.searchsorted(offsets, np.arange(0, offsets[-1] + _CHUNK, _CHUNK), side="left")
    bounds = np.unique(np.minimum(chunk, len(offsets) - 1))

    def work(index: int) -> _Part:
        return _core.triangulate(
            cam_from_world=cam_from_world,
            focal=focal,
            offsets=offsets,
            view=observations.view,
            rays=observations.rays,
            sigma=observations.sigma,
            first=int(bounds[index]),
            last=int(bounds[index + 1]),
            min_observations=options.min_observations,
            max_reprojection_error=options.max_reprojection_error,
            min_angle=math.radians(options.min_angle),
            max_depth_error=options.max_depth_error,
            sigma_floor=SIGMA_FLOOR,
            error_to_sigma=ERROR_TO_SIGMA,
        )

    none = np.empty(0, np.int64)
    parts: list[_Part] = [(np.empty((0, 3)), np.empty(0), none, none, 0, 0)]
    for index, part in enumerate(map_on_threads(work, range(len(bounds) - 1), num_threads)):
        parts.append(part)
        if progress is not None:
            progress(int(bounds[index + 1]))
    xyz, error, counts, observation, num_agreeing, num_tracks = zip(*parts, strict=True)
    return TriangulatedPoints(
        xyz=np.concatenate(xyz),
        error=np.concatenate(error),
        offsets=np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64),
        observation=np.concatenate(observation),
        num_agreeing=sum(num_agreeing),
        num_tracks=sum(num_tracks),
    )
