"""3D points of tracks on known poses: all tracks at once, robust and filtered."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.options import TriangulateOptions
from colmap_av1.util.cpus import threads_or_cpus

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]
# What the core returns for some of the tracks, see `TriangulatedPoints`.
_Part = tuple[_Floats, _Floats, _Ints, _Ints, int, int]

# Observations worked on at a time: few enough for progress and for all threads.
_CHUNK = 65_536
# Error in pixels that an observation has however accurate its motion is.
SIGMA_FLOOR = 0.3
# Error of a ray, where a point is looked at for the wrong distance, to its mean reprojection error.
ERROR_TO_SIGMA = 2.0


@dataclass(frozen=True)
class Views:
    """Images with known poses.

    Attributes:
        cam_from_world: float64 [n, 3, 4] poses, x_cam = R x_world + t.
        focal: float64 [n, 2] focal lengths along x and y in pixels; turns errors into pixels.
    """

    cam_from_world: _Floats
    focal: _Floats


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

    offsets: NDArray[np.int64]
    view: NDArray[np.int64]
    rays: _Floats
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
        num_agreeing: tracks of which enough observations agree with the poses, whether or not
            they have the parallax that a point needs.
        num_tracks: tracks that had enough observations.
    """

    xyz: _Floats
    error: _Floats
    offsets: NDArray[np.int64]
    observation: NDArray[np.int64]
    num_agreeing: int
    num_tracks: int


def triangulate(
    observations: Observations,
    views: Views,
    options: TriangulateOptions | None = None,
    *,
    num_threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> TriangulatedPoints:
    """Triangulate tracks on known poses.

    The first guess of a point is the best of several midpoints of two rays (Hartley and Sturm,
    "Triangulation", 1997), judged by all observations; Gauss-Newton steps on the reprojection
    error follow, weighted by the expected error of each observation and by how well it agrees.
    Observations beyond `max_reprojection_error`, or behind the camera, are dropped. What is dropped
    may be a separate point, where a track slid from one surface to another: it is tried once
    more. Rays that meet at an angle a and are off by e give a distance to e / a of it; where that
    is too much there is no point.

    Args:
        observations: the tracks.
        views: poses and focal lengths.
        options: what makes a point; the defaults of TriangulateOptions if None.
        num_threads: threads; None: one per CPU. The result does not depend on it.
        progress: called with the number of tracks done so far.

    Returns:
        The points, in the order of the tracks.
    """
    options = options if options is not None else TriangulateOptions()
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
    # The core releases the interpreter lock.
    with ThreadPoolExecutor(max_workers=threads_or_cpus(num_threads)) as executor:
        try:
            for index, part in enumerate(executor.map(work, range(len(bounds) - 1))):
                parts.append(part)
                if progress is not None:
                    progress(int(bounds[index + 1]))
        except BaseException:
            executor.shutdown(wait=True, cancel_futures=True)
            raise
    xyz, error, counts, observation, num_agreeing, num_tracks = zip(*parts, strict=True)
    return TriangulatedPoints(
        xyz=np.concatenate(xyz),
        error=np.concatenate(error),
        offsets=np.concatenate([[0], np.cumsum(np.concatenate(counts))]).astype(np.int64),
        observation=np.concatenate(observation),
        num_agreeing=sum(num_agreeing),
        num_tracks=sum(num_tracks),
    )
