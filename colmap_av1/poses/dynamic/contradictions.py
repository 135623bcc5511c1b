"""Tracks that contradict the camera over their whole length, or what is seen through their points.

What moves by itself leaves the epipolar lines of its first positions, but slowly where it moves
along with the camera or against it: then it looks like a point at a wrong distance. Such a point
would hide what other images see behind it, or is seen through a surface that others see before it.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.coverage import PosedCamera
from colmap_av1.geometry.triangulation import SIGMA_FLOOR, TriangulatedPoints
from colmap_av1.tracks.tracks import Tracks

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]
_Bools = NDArray[np.bool_]

# Expected errors that a track is off by, from which on it contradicts, and up to which it agrees.
# Drift is of one to two, a person who walks across the picture of five and more.
_CONTRADICTS = 2.5
_AGREES = 2.0
# Those from which on a track of so many images surely contradicts.
_SURELY_CONTRADICTS = 4.0
_SURE_LENGTH = 12
# Images that see a track which tells what is behind others.
_LONG = 5
# What a track is off by where it has no point, or lies behind the camera.
_MOST = 20.0
# A point before what others see by more than this factor would hide it; it does so in more than
# this share of the images that see enough there, of so many at least.
_HIDES = 1.3
_HIDDEN_SHARE = 0.5
_FEWEST_IMAGES = 3
_FEWEST_SEEN = 3
# Distances in steps, to tell how many points lie before another: by this many steps at least.
_STEP = 1.15
_NUM_STEPS = 40
_STEPS_BEFORE = 2
# Points of a surface before a track, where none is seen, in more than this share of its images.
_FEWEST_BEFORE = 4
_THROUGH_SHARE = 0.5
# Width in cells of what counts as around, odd.
_AROUND = 3


@dataclass(frozen=True)
class PlacedTracks:
    """Tracks with their points, in the cells of the images that see them.

    Attributes:
        shape: number of images, and of rows and columns of cells.
        cell: width of a cell in pixels.
        offsets: int64 [num_tracks + 1] the observations of each track.
        track: int64 [num_observations] track of each observation.
        image: int64 [num_observations] its image.
        row: int64 [num_observations] its cell's row.
        column: int64 [num_observations] its cell's column.
        depth: float64 [num_observations] depth of the track's point in the image; nan without one.
        off: float64 [num_tracks] root mean square of the errors over the expected ones.
        xyz: float64 [num_tracks, 3] the points; nan without one.
    """

    shape: tuple[int, int, int]
    cell: int
    offsets: _Ints
    track: _Ints
    image: _Ints
    row: _Ints
    column: _Ints
    depth: _Floats
    off: _Floats
    xyz: _Floats

    @property
    def lengths(self) -> _Ints:
        """Observations of each track, int64 [num_tracks]."""
        return np.diff(self.offsets)

    def mean(self, of_observations: NDArray[np.floating] | _Bools) -> _Floats:
        """Means over each track."""
        values = np.asarray(of_observations, dtype=np.float64)
        return np.asarray(np.add.reduceat(values, self.offsets[:-1]) / self.lengths)

    def counts(self, of_tracks: NDArray[np.floating] | _Bools) -> _Floats:
        """Float64 [images, rows, columns] sums over the observations in each cell."""
        _, rows, columns = self.shape
        cell = (self.image * rows + self.row) * columns + self.column
        weights = np.asarray(of_tracks, dtype=np.float64)[self.track]
        size = int(np.prod(self.shape))
        found = np.bincount(cell, weights=weights, minlength=size)
        return np.asarray(found.reshape(self.shape), dtype=np.float64)


def place_tracks(
    tracks: Tracks,
    image: _Ints,
    points: TriangulatedPoints,
    views: Sequence[PosedCamera],
    *,
    cell: int,
) -> PlacedTracks:
    """Tell how far tracks are off their points.

    Args:
        tracks: tracks in some images of one size.
        image: int64 [num_observations] the image of each observation.
        points: their points; of those of a track the one that most observations agree with counts.
        views: the images.
        cell: width of a cell in pixels.
    """
    offsets = tracks.offsets
    num_tracks = len(offsets) - 1
    track = np.repeat(np.arange(num_tracks), np.diff(offsets))
    xyz = np.full((num_tracks, 3), np.nan)
    sizes = np.diff(points.offsets)
    order = np.argsort(sizes, kind="stable")
    owner = track[points.observation[points.offsets[:-1]]]
    xyz[owner[order]] = points.xyz[order]
    error, depth = np.full(len(track), np.nan), np.full(len(track), np.nan)
    by_image = np.argsort(image, kind="stable")
    bounds = np.searchsorted(image[by_image], np.arange(len(views) + 1))
    for number, view in enumerate(views):
        own = by_image[bounds[number] : bounds[number + 1]]
        own = own[np.isfinite(xyz[track[own], 0])]
        pose = view.cam_from_world
        local = xyz[track[own]] @ pose[:, :3].T + pose[:, 3]
        before = local[:, 2] > 0
        own, local = own[before], local[before]
        seen = np.asarray(view.camera.img_from_cam(local)).reshape(-1, 2)
        error[own] = np.linalg.norm(seen - tracks.xy[own], axis=1)
        depth[own] = local[:, 2]
    expected = np.hypot(SIGMA_FLOOR, tracks.sigma)
    off = np.minimum(np.nan_to_num(error / expected, nan=_MOST), _MOST)
    columns, rows = (-(-length // cell) for length in views[0].size)
    column, row = (tracks.xy // cell).astype(np.int64).T
    squared = np.add.reduceat(off**2, offsets[:-1]) / np.diff(offsets)
    return PlacedTracks(
        shape=(len(views), rows, columns),
        cell=cell,
        offsets=offsets,
        track=track,
        image=image,
        row=np.clip(row, 0, rows - 1),
        column=np.clip(column, 0, columns - 1),
        depth=depth,
        off=np.sqrt(squared),
        xyz=xyz,
    )


@dataclass(frozen=True)
class _Shown:
    """Where points lie in an image that does not see their tracks: cells and depths."""

    track: NDArray[np.int32]
    row: NDArray[np.int16]
    column: NDArray[np.int16]
    depth: NDArray[np.float32]


class Contradictions:
    """What contradicts the camera among some tracks.

    Args:
        placed: the tracks.
        views: the images.
    """

    def __init__(self, placed: PlacedTracks, views: Sequence[PosedCamera]) -> None:
        self._placed = placed
        by_image = np.argsort(placed.image, kind="stable")
        bounds = np.searchsorted(placed.image[by_image], np.arange(len(views) + 1))
        self._seen = [by_image[a:b] for a, b in itertools.pairwise(bounds)]
        there = np.flatnonzero(np.isfinite(placed.xyz[:, 0]))
        self._shown = [
            self._show(view, there, rows) for view, rows in zip(views, self._seen, strict=True)
        ]

    @property
    def by_motion(self) -> _Bools:
        """Bool [num_tracks] tracks that agree with no point over their whole length."""
        return np.asarray(self._placed.off > _CONTRADICTS)

    @property
    def surely_by_motion(self) -> _Bools:
        """Those of them that do so in many images, and by far: what drifts seldom lasts."""
        placed = self._placed
        return np.asarray((placed.off > _SURELY_CONTRADICTS) & (placed.lengths >= _SURE_LENGTH))

    def by_depth(self, moving: _Bools) -> _Bools:
        """Tracks whose points would hide what others see, or are seen through a surface.

        Args:
            moving: bool [num_tracks] tracks that are known to move, and prove nothing.
        """
        agreeing = self._agreeing & ~moving
        hiding = self._hiding(agreeing)
        return hiding | self._seen_through(agreeing & ~hiding)

    def unseen(self, left_out: _Bools) -> _Floats:
        """Points that agree, in the cells of the images that they lie in but are not seen in.

        Args:
            left_out: bool [num_tracks] tracks that prove nothing.

        Returns:
            float64 [images, rows, columns] their numbers.
        """
        agreeing = self._agreeing & ~left_out & (self._placed.lengths >= _LONG)
        found = np.zeros(self._placed.shape)
        for own, shown in zip(found, self._shown, strict=True):
            kept = agreeing[shown.track]
            np.add.at(own, (shown.row[kept], shown.column[kept]), 1.0)
        return found

    @property
    def _agreeing(self) -> _Bools:
        placed = self._placed
        return np.asarray((placed.off < _AGREES) & np.isfinite(placed.xyz[:, 0]))

    def _show(self, view: PosedCamera, there: _Ints, rows: _Ints) -> _Shown:
        placed = self._placed
        index, xy, depth = view.project(placed.xyz[there])
        track = there[index]
        is_seen = np.zeros(len(placed.xyz), np.bool_)
        is_seen[placed.track[rows]] = True
        unseen = np.flatnonzero(~is_seen[track])
        # Whole pixels first: NumPy divides these many times as fast. There are up to 65,536.
        cell = (xy[unseen].astype(np.int32) // np.int32(placed.cell)).astype(np.int16)
        own = track[unseen].astype(np.int32)
        return _Shown(own, cell[:, 1], cell[:, 0], depth[unseen].astype(np.float32))

    def _hiding(self, agreeing: _Bools) -> _Bools:
        from scipy.ndimage import minimum_filter, uniform_filter  # noqa: PLC0415 - slow to import

        placed = self._placed
        _, rows, columns = placed.shape
        hides, looked = np.zeros(len(agreeing)), np.zeros(len(agreeing))
        for seen, shown in zip(self._seen, self._shown, strict=True):
            own = seen[agreeing[placed.track[seen]]]
            at = placed.row[own] * columns + placed.column[own]
            in_cells = np.full(rows * columns, np.inf)
            np.minimum.at(in_cells, at, placed.depth[own])
            nearest = minimum_filter(in_cells.reshape(rows, columns), _AROUND, mode="nearest")
            counts = np.bincount(at, minlength=rows * columns).astype(np.float64)
            count = uniform_filter(counts.reshape(rows, columns), _AROUND, mode="constant")
            count *= _AROUND**2
            enough = count[shown.row, shown.column] > _FEWEST_SEEN - 0.5
            track = shown.track[enough]
            looked[track] += 1
            before = shown.depth * _HIDES < nearest[shown.row, shown.column]
            hides[track] += before[enough]
        return (hides > _HIDDEN_SHARE * looked) & (looked >= _FEWEST_IMAGES)

    def _seen_through(self, agreeing: _Bools) -> _Bools:
        placed = self._placed
        known = placed.depth[np.isfinite(placed.depth)]
        nearest = float(np.quantile(known, 0.001)) if len(known) else 1.0

        def steps(depth: NDArray[np.floating]) -> _Ints:
            with np.errstate(divide="ignore", invalid="ignore"):
                found = np.floor(np.log(depth / nearest) / np.log(_STEP))
            return np.asarray(np.clip(np.nan_to_num(found), 0, _NUM_STEPS - 1), np.int64)

        through = np.zeros(len(agreeing))
        for rows, shown in zip(self._seen, self._shown, strict=True):
            own = rows[np.isfinite(placed.depth[rows])]
            kept = agreeing[shown.track]
            proof = own[agreeing[placed.track[own]]]
            step = steps(placed.depth[own]) - _STEPS_BEFORE
            at = placed.row[own], placed.column[own], np.maximum(step, 0)
            there = self._at_most(shown.row[kept], shown.column[kept], steps(shown.depth[kept]), at)
            seen = self._at_most(
                placed.row[proof], placed.column[proof], steps(placed.depth[proof]), at
            )
            is_through = (there >= _FEWEST_BEFORE) & (seen == 0) & (step >= 0)
            # An image sees a track once.
            through[placed.track[own]] += is_through
        return np.asarray(through > _THROUGH_SHARE * placed.lengths)

    def _at_most(
        self,
        row: NDArray[np.integer],
        column: NDArray[np.integer],
        step: _Ints,
        at: tuple[_Ints, _Ints, _Ints],
    ) -> _Ints:
        """Numbers of points around cells that are as near as a step, or nearer.

        Args:
            row: integers [n] the cell's row of each point.
            column: integers [n] its column.
            step: int64 [n] the step of its depth.
            at: int64 [m] rows and columns of the cells asked for, and the step for each.
        """
        # With an edge of empty cells, so that each has all of those around it.
        edge = _AROUND // 2
        _, rows, columns = self._placed.shape
        stride, size = columns + 2 * edge, (rows + 2 * edge) * (columns + 2 * edge)
        cell = (row.astype(np.int64) + edge) * stride + column + edge
        count = np.bincount(step * size + cell, minlength=size * _NUM_STEPS)
        steps = count.reshape(_NUM_STEPS, size)
        for step_number in range(1, _NUM_STEPS):
            steps[step_number] += steps[step_number - 1]
        first = at[2] * size + at[0] * stride + at[1]
        around = [down * stride + across for down in range(_AROUND) for across in range(_AROUND)]
        return np.asarray(sum(count[first + beside] for beside in around), np.int64)
