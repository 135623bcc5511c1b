"""Tracks that contradict the poses over their whole length, or the visibility of other points.

A dynamic point leaves the epipolar lines of its first positions, but only slowly if it moves
parallel to the camera's path: it then looks like a static point at a wrong depth. Such a point
would occlude points that other images see, or be occluded by a surface that others see.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.geometry.track_points import TriangulatedTracks
from colmap_av1.geometry.triangulation import SIGMA_FLOOR
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.grouping import groups
from colmap_av1.util.threads import map_on_threads

# Residual of a track, in expected errors, above which it contradicts the poses and below which it
# agrees with them. Drift causes one to two, a person who walks across the picture five or more.
_CONTRADICTS = 2.5
_AGREES = 2.0
# Residual above which a track of at least this length in images certainly contradicts.
_SURELY_CONTRADICTS = 4.0
_SURE_LENGTH = 12
# Smallest length in images of a track that is evidence for what lies behind other points.
_LONG = 5
# Largest residual of an observation, and its value where the track has no point or the point lies
# behind the camera.
_MAX_RESIDUAL = 20.0
# A point would occlude its surroundings in an image if these are farther by more than the first
# factor. It contradicts them if it would do so in more than the second share of the images that
# observe enough points there. The last two values are the fewest such images and points.
_HIDES = 1.3
_HIDDEN_SHARE = 0.5
_MIN_IMAGES = 3
_MIN_POINTS_BEHIND = 3
# Depths are quantized in steps of this factor, and one point is in front of another if it is nearer
# by at least this many steps.
_STEP = 1.15
_NUM_STEPS = 40
_STEPS_BEFORE = 2
# A track is seen through a surface where at least this many points should lie in front of it and
# none is observed there. It contradicts if this holds in more than this share of its images.
_MIN_BEFORE = 4
_THROUGH_SHARE = 0.5
# Width in cells of a neighbourhood; odd.
_AROUND = 3
# Points are projected once into each image, and their projections are kept, if there are at most
# this many. Otherwise they are projected again whenever they are needed.
_MAX_KEPT = 40_000_000


@dataclass(frozen=True)
class TracksInCells:
    """Tracks with their points, and the grid cells of their observations.

    Attributes:
        shape: number of images, and of rows and columns of cells.
        cell: width of a cell in pixels.
        offsets: int64 [num_tracks + 1] start of the observations of each track.
        track: int64 [num_observations] track of each observation.
        image: int64 [num_observations] its image.
        row: int64 [num_observations] row of its cell.
        column: int64 [num_observations] column of its cell.
        depth: float64 [num_observations] depth of the track's point in the image; nan without one.
        residual: float64 [num_tracks] root mean square of the ratio of reprojection errors to
            expected errors.
        xyz: float64 [num_tracks, 3] the points; nan without one.
    """

    shape: tuple[int, int, int]
    cell: int
    offsets: Ints
    track: Ints
    image: Ints
    row: Ints
    column: Ints
    depth: Floats
    residual: Floats
    xyz: Floats

    @property
    def lengths(self) -> Ints:
        """Observations of each track, int64 [num_tracks]."""
        return np.diff(self.offsets)

    def mean(self, of_observations: NDArray[np.floating] | Bools) -> Floats:
        """Means over each track."""
        values = np.asarray(of_observations, dtype=np.float64)
        return np.asarray(np.add.reduceat(values, self.offsets[:-1]) / self.lengths)

    def counts(self, of_tracks: NDArray[np.floating] | Bools) -> Floats:
        """Float64 [images, rows, columns] sums over the observations in each cell."""
        _, rows, columns = self.shape
        cell = (self.image * rows + self.row) * columns + self.column
        weights = np.asarray(of_tracks, dtype=np.float64)[self.track]
        size = int(np.prod(self.shape))
        found = np.bincount(cell, weights=weights, minlength=size)
        return np.asarray(found.reshape(self.shape), dtype=np.float64)


def tracks_in_cells(
    triangulated: TriangulatedTracks, views: Sequence[PosedCamera], cell: int
) -> TracksInCells:
    """Compute the residuals, depths and cells of tracks.

    Args:
        triangulated: tracks in some images of one size; for a track with several points, the one
            with the most inliers is used.
        views: the images.
        cell: width of a cell in pixels.
    """
    tracks, image, points = triangulated.tracks, triangulated.view, triangulated.points
    offsets = tracks.offsets
    track = tracks.track
    xyz = np.full((tracks.num_tracks, 3), np.nan)
    sizes = np.diff(points.offsets)
    order = np.argsort(sizes, kind="stable")
    owner = track[points.observation[points.offsets[:-1]]]
    xyz[owner[order]] = points.xyz[order]
    error, depth = np.full(len(track), np.nan), np.full(len(track), np.nan)
    for view, seen in zip(views, groups(image, len(views)), strict=True):
        own = seen[np.isfinite(xyz[track[seen], 0])]
        local = view.in_camera(xyz[track[own]])
        ahead = local[:, 2] > 0
        own, local = own[ahead], local[ahead]
        error[own] = np.linalg.norm(view.pixels(local) - tracks.xy[own], axis=1)
        depth[own] = local[:, 2]
    expected = np.hypot(SIGMA_FLOOR, tracks.sigma)
    ratio = np.minimum(np.nan_to_num(error / expected, nan=_MAX_RESIDUAL), _MAX_RESIDUAL)
    columns, rows = (-(-length // cell) for length in views[0].size)
    column, row = (tracks.xy // cell).astype(np.int64).T
    squared = np.add.reduceat(ratio**2, offsets[:-1]) / np.diff(offsets)
    return TracksInCells(
        shape=(len(views), rows, columns),
        cell=cell,
        offsets=offsets,
        track=track,
        image=image,
        row=np.clip(row, 0, rows - 1),
        column=np.clip(column, 0, columns - 1),
        depth=depth,
        residual=np.sqrt(squared),
        xyz=xyz,
    )


@dataclass(frozen=True)
class _Shown:
    """Cells and depths of the points that project into an image but have no observation there."""

    track: NDArray[np.int32]
    row: NDArray[np.int16]
    column: NDArray[np.int16]
    depth: NDArray[np.float32]


class Contradictions:
    """Finds the tracks that contradict the poses.

    Args:
        tracks: the tracks.
        views: the images.
        num_threads: number of threads; None: one per CPU. The result does not depend on it.
    """

    def __init__(
        self,
        tracks: TracksInCells,
        views: Sequence[PosedCamera],
        *,
        num_threads: int | None = None,
    ) -> None:
        self._tracks, self._num_threads = tracks, num_threads
        self._seen = groups(tracks.image, len(views))
        self._views = views
        self._there = np.flatnonzero(np.isfinite(tracks.xyz[:, 0]))
        self._kept: list[_Shown] | None = None
        if len(views) * len(self._there) <= _MAX_KEPT:
            self._kept = list(map_on_threads(self._show, range(len(views)), num_threads))

    @property
    def by_motion(self) -> Bools:
        """Bool [num_tracks] tracks that fit no single point over their whole length."""
        return np.asarray(self._tracks.residual > _CONTRADICTS)

    @property
    def surely_by_motion(self) -> Bools:
        """Bool [num_tracks] long tracks with large residuals; drifting tracks are seldom long."""
        tracks = self._tracks
        return np.asarray(
            (tracks.residual > _SURELY_CONTRADICTS) & (tracks.lengths >= _SURE_LENGTH)
        )

    def by_depth(self, dynamic: Bools) -> Bools:
        """Tracks whose points would occlude other points, or are seen through a surface.

        Args:
            dynamic: bool [num_tracks] tracks known to be dynamic, which are not used as evidence.
        """
        agreeing = self._agreeing & ~dynamic
        hiding = self._hiding(agreeing)
        return hiding | self._seen_through(agreeing & ~hiding)

    def unseen(self, excluded: Bools) -> Floats:
        """Count the agreeing points that project into each cell of images not observing them.

        Args:
            excluded: bool [num_tracks] tracks that are not used as evidence.

        Returns:
            float64 [images, rows, columns].
        """
        agreeing = self._agreeing & ~excluded & (self._tracks.lengths >= _LONG)
        found = np.zeros(self._tracks.shape)
        images = map_on_threads(self._shown, range(len(found)), self._num_threads)
        for own, shown in zip(found, images, strict=True):
            kept = agreeing[shown.track]
            np.add.at(own, (shown.row[kept], shown.column[kept]), 1.0)
        return found

    @property
    def _agreeing(self) -> Bools:
        tracks = self._tracks
        return np.asarray((tracks.residual < _AGREES) & np.isfinite(tracks.xyz[:, 0]))

    def _shown(self, image: int) -> _Shown:
        return self._kept[image] if self._kept is not None else self._show(image)

    def _show(self, image: int) -> _Shown:
        tracks = self._tracks
        index, xy, depth = self._views[image].project(tracks.xyz[self._there])
        track = self._there[index]
        is_seen = np.zeros(len(tracks.xyz), np.bool_)
        is_seen[tracks.track[self._seen[image]]] = True
        unseen = np.flatnonzero(~is_seen[track])
        # NumPy divides integers many times faster. Positions are at most 65,536.
        cell = (xy[unseen].astype(np.int32) // np.int32(tracks.cell)).astype(np.int16)
        own = track[unseen].astype(np.int32)
        return _Shown(own, cell[:, 1], cell[:, 0], depth[unseen].astype(np.float32))

    def _hiding(self, agreeing: Bools) -> Bools:
        from scipy.ndimage import minimum_filter, uniform_filter  # noqa: PLC0415 - slow to import

        tracks = self._tracks
        _, rows, columns = tracks.shape
        hides, looked = np.zeros(len(agreeing)), np.zeros(len(agreeing))

        def hiding_in(image: int) -> tuple[NDArray[np.int32], Bools]:
            """The tracks with enough points around them, and whether each would hide those."""
            seen, shown = self._seen[image], self._shown(image)
            own = seen[agreeing[tracks.track[seen]]]
            at = tracks.row[own] * columns + tracks.column[own]
            in_cells = np.full(rows * columns, np.inf)
            np.minimum.at(in_cells, at, tracks.depth[own])
            nearest = minimum_filter(in_cells.reshape(rows, columns), _AROUND, mode="nearest")
            counts = np.bincount(at, minlength=rows * columns).astype(np.float64)
            count = uniform_filter(counts.reshape(rows, columns), _AROUND, mode="constant")
            count *= _AROUND**2
            enough = count[shown.row, shown.column] > _MIN_POINTS_BEHIND - 0.5
            is_nearer = shown.depth * _HIDES < nearest[shown.row, shown.column]
            return shown.track[enough], is_nearer[enough]

        for track, is_nearer in map_on_threads(
            hiding_in, range(len(self._seen)), self._num_threads
        ):
            looked[track] += 1
            hides[track] += is_nearer
        return (hides > _HIDDEN_SHARE * looked) & (looked >= _MIN_IMAGES)

    def _seen_through(self, agreeing: Bools) -> Bools:
        tracks = self._tracks
        known = tracks.depth[np.isfinite(tracks.depth)]
        nearest = float(np.quantile(known, 0.001)) if len(known) else 1.0

        def steps(depth: NDArray[np.floating]) -> Ints:
            with np.errstate(divide="ignore", invalid="ignore"):
                found = np.floor(np.log(depth / nearest) / np.log(_STEP))
            return np.asarray(np.clip(np.nan_to_num(found), 0, _NUM_STEPS - 1), np.int64)

        through = np.zeros(len(agreeing))

        def through_in(image: int) -> tuple[Ints, Bools]:
            """The tracks with points, and whether they are seen through a surface."""
            rows, shown = self._seen[image], self._shown(image)
            own = rows[np.isfinite(tracks.depth[rows])]
            kept = agreeing[shown.track]
            proof = own[agreeing[tracks.track[own]]]
            step = steps(tracks.depth[own]) - _STEPS_BEFORE
            at = tracks.row[own], tracks.column[own], np.maximum(step, 0)
            there = self._at_most(shown.row[kept], shown.column[kept], steps(shown.depth[kept]), at)
            seen = self._at_most(
                tracks.row[proof], tracks.column[proof], steps(tracks.depth[proof]), at
            )
            is_through = (there >= _MIN_BEFORE) & (seen == 0) & (step >= 0)
            return tracks.track[own], np.asarray(is_through)

        for track, is_through in map_on_threads(
            through_in, range(len(self._seen)), self._num_threads
        ):
            # `+=` suffices: a track has one observation per image.
            through[track] += is_through
        return np.asarray(through > _THROUGH_SHARE * tracks.lengths)

    def _at_most(
        self,
        row: NDArray[np.integer],
        column: NDArray[np.integer],
        step: Ints,
        at: tuple[Ints, Ints, Ints],
    ) -> Ints:
        """Count the points around cells whose depth step does not exceed a limit.

        Args:
            row: integers [n] row of the cell of each point.
            column: integers [n] its column.
            step: int64 [n] its depth step.
            at: int64 [m] rows and columns of the queried cells, and the limit for each.
        """
        # A border of empty cells completes the neighbourhoods of the outer ones.
        edge = _AROUND // 2
        _, rows, columns = self._tracks.shape
        stride, size = columns + 2 * edge, (rows + 2 * edge) * (columns + 2 * edge)
        cell = (row.astype(np.int64) + edge) * stride + column + edge
        count = np.bincount(step * size + cell, minlength=size * _NUM_STEPS)
        steps = count.reshape(_NUM_STEPS, size)
        np.cumsum(steps, axis=0, out=steps)
        first = at[2] * size + at[0] * stride + at[1]
        around = [down * stride + across for down in range(_AROUND) for across in range(_AROUND)]
        return np.asarray(sum(count[first + shift] for shift in around), np.int64)
