"""3D points of tracks on known poses: all tracks at once, robust and filtered."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.model.colmap_model import camera_centres
from colmap_av1.options import TriangulateOptions
from colmap_av1.util.cpus import threads_or_cpus

_Floats = NDArray[np.float64]

# Observations worked on at a time: as many as stay in a processor's cache.
_CHUNK = 16_384
# Two rays that a first guess is made of, by their place in the track from 0 to 1.
_GUESSES = ((0.0, 1.0), (0.0, 0.5), (0.5, 1.0), (0.25, 0.75))
_ITERATIONS = 4
# A step that leaves more than this share of a track's cost is its last.
_CONVERGED = 0.999
# Error in pixels at which an observation counts half.
_SOFT_ERROR = 1.0
# Error in pixels that an observation has however accurate its motion is.
SIGMA_FLOOR = 0.3
# Error of a ray, where a point is looked at for the wrong distance, to its mean reprojection error.
ERROR_TO_SIGMA = 2.0
# Smallest eigenvalue of the normal equations, as a share of their trace, that is no plain
# singularity.
_SINGULAR = 1e-12


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

    def part(self, first: int, last: int) -> Observations:
        """Those of the tracks from `first` to before `last`."""
        offsets = self.offsets[first : last + 1]
        chosen = slice(int(offsets[0]), int(offsets[-1]))
        return Observations(
            offsets - offsets[0], self.view[chosen], self.rays[chosen], self.sigma[chosen]
        )


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
    chunk = np.searchsorted(offsets, np.arange(0, offsets[-1] + _CHUNK, _CHUNK), side="left")
    bounds = np.unique(np.minimum(chunk, len(offsets) - 1))
    parts: list[_Part] = []

    def work(index: int) -> _Part:
        first, last = int(bounds[index]), int(bounds[index + 1])
        part = _triangulate_part(observations.part(first, last), views, options)
        return replace(part, observation=part.observation + offsets[first])

    # NumPy's loops release the interpreter lock.
    with ThreadPoolExecutor(max_workers=threads_or_cpus(num_threads)) as executor:
        try:
            for index, part in enumerate(executor.map(work, range(len(bounds) - 1))):
                parts.append(part)
                if progress is not None:
                    progress(int(bounds[index + 1]))
        except BaseException:
            executor.shutdown(wait=True, cancel_futures=True)
            raise
    parts = [_no_points(0, 0), *parts]
    counts = np.concatenate([part.counts for part in parts])
    return TriangulatedPoints(
        xyz=np.concatenate([part.xyz for part in parts]),
        error=np.concatenate([part.error for part in parts]),
        offsets=np.concatenate([[0], np.cumsum(counts)]).astype(np.int64),
        observation=np.concatenate([part.observation for part in parts]),
        num_agreeing=sum(part.num_agreeing for part in parts),
        num_tracks=sum(part.num_tracks for part in parts),
    )


@dataclass(frozen=True)
class _Part:
    """`TriangulatedPoints` of some of the tracks, with the number of observations of each."""

    xyz: _Floats
    error: _Floats
    counts: NDArray[np.int64]
    observation: NDArray[np.int64]
    num_agreeing: int
    num_tracks: int


def _no_points(num_agreeing: int, num_tracks: int) -> _Part:
    none = np.empty(0, np.int64)
    return _Part(np.empty((0, 3)), np.empty(0), none, none, num_agreeing, num_tracks)


def _triangulate_part(
    observations: Observations, views: Views, options: TriangulateOptions
) -> _Part:
    num_tracks = len(observations.offsets) - 1
    track = np.repeat(np.arange(num_tracks), np.diff(observations.offsets))
    left = np.flatnonzero(np.isfinite(observations.rays).all(axis=1))
    found: list[tuple[NDArray[Any], ...]] = []
    used_rows: list[NDArray[np.int64]] = []
    num_agreeing = num_tried = 0
    for attempt in range(2):
        counts = np.bincount(track[left], minlength=num_tracks)
        left = left[counts[track[left]] >= options.min_observations]
        if len(left) == 0:
            break
        starts = np.flatnonzero(np.diff(track[left], prepend=-1))
        group = _group(starts, observations, left, views)
        xyz, kept, error, agrees = _solve(group, options)
        if attempt == 0:
            num_tried, num_agreeing = len(starts), int(agrees.sum())
        sizes = np.add.reduceat(kept.astype(np.int64), starts)
        mean_error = np.add.reduceat(error, starts) / np.maximum(sizes, 1)
        good = agrees & _is_sure(group, _widest_angle(group, xyz, kept), mean_error, options)
        used = kept & good[group.track]
        owner = track[left[starts]]
        found.append((owner[good], xyz[good], mean_error[good], sizes[good]))
        used_rows.append(left[used])
        left = left[~kept & agrees[group.track]]
    if not found:
        return _no_points(num_agreeing, num_tried)
    owner, xyz, error, sizes = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.argsort(owner, kind="stable")
    rank = np.empty(len(owner), np.int64)
    rank[order] = np.arange(len(owner))
    by_point = np.argsort(np.repeat(rank, sizes), kind="stable")
    observation = np.concatenate(used_rows)[by_point]
    return _Part(xyz[order], error[order], sizes[order], observation, num_agreeing, num_tried)


@dataclass(frozen=True)
class _Group:
    """Observations of some tracks, each with its camera.

    Attributes:
        starts: int64 [num_tracks] first observation of each track.
        track: int64 [n] track of each observation.
        view: int64 [n] its view.
        rays: float64 [2, n] as in `Observations`, by coordinate.
        weight: float64 [n] inverse expected variance.
        pose: float64 [3, 4, n] pose of its view.
        focal: float64 [2, n] focal lengths of its view.
        views: all views.
    """

    starts: NDArray[np.int64]
    track: NDArray[np.int64]
    view: NDArray[np.int64]
    rays: _Floats
    weight: _Floats
    pose: _Floats
    focal: _Floats
    views: Views

    def part(self, chosen: NDArray[np.bool_]) -> _Group:
        """Some of the tracks."""
        own = np.flatnonzero(chosen[self.track])
        track = (np.cumsum(chosen) - 1)[self.track[own]]
        return _Group(
            starts=np.flatnonzero(np.diff(track, prepend=-1)),
            track=track,
            view=self.view[own],
            rays=self.rays[:, own],
            weight=self.weight[own],
            pose=self.pose[:, :, own],
            focal=self.focal[:, own],
            views=self.views,
        )

    def project(self, xyz: _Floats) -> tuple[_Floats, _Floats, _Floats]:
        """Points of the tracks in the cameras.

        Returns:
            float64 [2, n] (x / z, y / z), and [n] depth, and [n] squared error in px^2, which is
            inf behind the camera.
        """
        x, y, z = xyz[self.track].T
        u, v, depth = (r[0] * x + r[1] * y + r[2] * z + r[3] for r in self.pose)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            projected = np.stack([u, v]) / depth
            off = (projected - self.rays) * self.focal
            error = off[0] ** 2 + off[1] ** 2
        error[~(depth > 0) | ~np.isfinite(error)] = np.inf
        return projected, depth, error


def _group(
    starts: NDArray[np.int64], observations: Observations, rows: NDArray[np.int64], views: Views
) -> _Group:
    """Some rows of the observations; a track begins at each of `starts` among them."""
    view = observations.view[rows]
    pose = np.ascontiguousarray(views.cam_from_world.transpose(1, 2, 0))
    return _Group(
        starts=starts,
        track=np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(rows)))),
        view=view,
        rays=np.ascontiguousarray(observations.rays[rows].T),
        weight=1.0 / (SIGMA_FLOOR**2 + observations.sigma[rows].astype(np.float64) ** 2),
        pose=pose[:, :, view],
        focal=np.ascontiguousarray(views.focal.T)[:, view],
        views=views,
    )


def _solve(
    group: _Group, options: TriangulateOptions
) -> tuple[_Floats, NDArray[np.bool_], _Floats, NDArray[np.bool_]]:
    """Points of the tracks; which observations agree, their errors; which tracks do."""
    limit = options.max_reprojection_error**2
    xyz = np.zeros((len(group.starts), 3))
    cost = np.full(len(xyz), np.inf)
    for one, two in _GUESSES:
        guess = _midpoint(group, one, two)
        now = np.add.reduceat(np.minimum(group.project(guess)[2], limit), group.starts)
        better = now < cost
        xyz[better], cost[better] = guess[better], now[better]

    moving, part = np.arange(len(xyz)), group
    for _ in range(_ITERATIONS):
        moved = xyz[moving] - _step(part, xyz[moving], limit)
        then = np.add.reduceat(np.minimum(part.project(moved)[2], limit), part.starts)
        # A step that makes things worse is not taken.
        better = then < cost[moving]
        going_on = then < _CONVERGED * cost[moving]
        xyz[moving[better]], cost[moving[better]] = moved[better], then[better]
        moving, part = moving[going_on], part.part(going_on)
        if len(moving) == 0:
            break
    error = group.project(xyz)[2]
    kept = error <= limit
    agrees = np.add.reduceat(kept.astype(np.int64), group.starts) >= options.min_observations
    return xyz, kept, np.sqrt(np.where(kept, error, 0.0)), agrees


def _step(group: _Group, xyz: _Floats, limit: float) -> _Floats:
    """Gauss-Newton steps of the points, float64 [num_tracks, 3]; zero where there is none."""
    projected, depth, error = group.project(xyz)
    kept = error <= limit
    weight = np.where(kept, group.weight / (1.0 + np.where(kept, error, 0.0) / _SOFT_ERROR**2), 0.0)
    projected = np.where(kept, projected, 0.0)
    scale = group.focal / np.where(kept, depth, 1.0)
    residual = (projected - group.rays) * group.focal
    # Derivative of the projection with respect to the point in the world: [2][3] arrays.
    jacobian = [
        [scale[k] * (group.pose[k, i] - projected[k] * group.pose[2, i]) for i in range(3)]
        for k in range(2)
    ]
    weighted = [[weight * j for j in row] for row in jacobian]
    normal = np.empty((len(xyz), 3, 3))
    gradient = np.empty((len(xyz), 3))
    for i in range(3):
        gradient[:, i] = np.add.reduceat(
            weighted[0][i] * residual[0] + weighted[1][i] * residual[1], group.starts
        )
        for j in range(i, 3):
            entry = weighted[0][i] * jacobian[0][j] + weighted[1][i] * jacobian[1][j]
            normal[:, i, j] = normal[:, j, i] = np.add.reduceat(entry, group.starts)
    trace = np.trace(normal, axis1=1, axis2=2)
    solvable = np.isfinite(trace) & (np.linalg.det(normal) > _SINGULAR * trace**3)
    step = np.zeros_like(xyz)
    step[solvable] = np.linalg.solve(normal[solvable], gradient[solvable, :, None])[..., 0]
    return step


def _midpoint(group: _Group, one: float, two: float) -> _Floats:
    """The point midway between two rays of each track, where they come closest."""
    last = np.bincount(group.track, minlength=len(group.starts)) - 1
    a = group.starts + np.floor(one * last).astype(np.int64)
    b = group.starts + np.ceil(two * last).astype(np.int64)
    da, db = _directions(group, a), _directions(group, b)
    centre = camera_centres(group.views.cam_from_world)
    ca, cb = centre[group.view[a]], centre[group.view[b]]
    between = cb - ca
    cosine = np.einsum("ni,ni->n", da, db)
    along_a = np.einsum("ni,ni->n", da, between)
    along_b = np.einsum("ni,ni->n", db, between)
    sine2 = np.maximum(1.0 - cosine**2, _SINGULAR)
    on_a = ca + da * ((along_a - cosine * along_b) / sine2)[:, None]
    on_b = cb + db * ((cosine * along_a - along_b) / sine2)[:, None]
    return np.asarray((on_a + on_b) / 2)


def _directions(group: _Group, rows: NDArray[np.int64]) -> _Floats:
    """Unit vectors of some rays in the world, float64 [n, 3]."""
    rays = np.column_stack([group.rays[:, rows].T, np.ones(len(rows))])
    rotation = group.views.cam_from_world[group.view[rows], :, :3]
    direction = np.einsum("nji,nj->ni", rotation, rays)
    return np.asarray(direction / np.linalg.norm(direction, axis=1, keepdims=True))


def _widest_angle(group: _Group, xyz: _Floats, kept: NDArray[np.bool_]) -> _Floats:
    """Angles in radians at which the rays of the kept observations meet, float64 [num_tracks].

    Measured against the first and the last of them, so at most a little less than the widest.
    """
    ray = np.ascontiguousarray(
        (xyz[group.track] - camera_centres(group.views.cam_from_world)[group.view]).T
    )
    norm = np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
    ray /= np.where(norm > 0, norm, 1.0)
    index = np.arange(len(kept))
    first = np.minimum.reduceat(np.where(kept, index, len(kept) - 1), group.starts)
    last = np.maximum.reduceat(np.where(kept, index, 0), group.starts)
    narrowest = np.ones(len(xyz))
    for end in (first, last):
        x, y, z = ray[:, end][:, group.track]
        cosine = ray[0] * x + ray[1] * y + ray[2] * z
        narrowest = np.minimum(
            narrowest, np.minimum.reduceat(np.where(kept, cosine, 1.0), group.starts)
        )
    return np.asarray(np.arccos(np.clip(narrowest, -1.0, 1.0)))


def _is_sure(
    group: _Group, angle: _Floats, error: _Floats, options: TriangulateOptions
) -> NDArray[np.bool_]:
    """Whether points with these triangulation angles and mean errors have an accurate depth."""
    wide = angle >= math.radians(options.min_angle)
    if options.max_depth_error is None:
        return wide
    # All observations of a track may be off alike, which its errors show only in part.
    pixels = np.hypot(SIGMA_FLOOR, ERROR_TO_SIGMA * error)
    focal = group.focal[:, group.starts].mean(axis=0)
    return np.asarray(wide & (pixels <= options.max_depth_error * focal * angle))
