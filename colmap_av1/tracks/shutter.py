"""Correct tracks for a rolling shutter, which reads the rows of a picture one after another."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats

# Width in pixels of the cells of a picture over which velocities are averaged. The velocity of a
# single track is too noisy for the small corrections here, and neighbouring points move alike.
_CELL = 32
# Weights of the motion over one and two frames in the derivative of a cubic fitted to five frames.
_NEAR, _FAR = 2 / 3, -1 / 12


def velocities(tracks: Tracks) -> Floats:
    """Velocity at each observation in pixels per frame: float64 [num_observations, 2].

    It is the derivative of a cubic fitted to the frames up to two away, if the track has all of
    them; a line would smooth out the shake of a hand. Otherwise it is the derivative of a parabola
    through both neighbours, or the step to the only neighbour; 0 without neighbours. Velocities
    are averaged over cells of each picture.
    """
    ahead, far_ahead = (_steps(tracks, shift) for shift in (1, 2))
    behind, far_behind = _back(ahead, 1), _back(far_ahead, 2)
    found = _NEAR * (ahead + behind) + _FAR * (far_ahead + far_behind)
    for other in ((ahead + behind) / 2, ahead, behind, 0.0):
        found = np.where(np.isfinite(found), found, other)
    return _mean_of_cells(tracks, found)


def _mean_of_cells(tracks: Tracks, values: Floats) -> Floats:
    """The mean of values [num_observations, 2] over all observations in the same cell."""
    columns = -(-tracks.width // _CELL) + 2
    rows = -(-tracks.height // _CELL) + 2
    cell = np.clip(tracks.xy // _CELL, -1, [columns - 2, rows - 2]).astype(np.int64) + 1
    key = (tracks.frame.astype(np.int64) * rows + cell[:, 1]) * columns + cell[:, 0]
    count = np.bincount(key)
    sums = [np.bincount(key, weights=values[:, k]) for k in (0, 1)]
    mean = np.column_stack([total[key] for total in sums]) / count[key, None]
    return np.asarray(mean)


def _steps(tracks: Tracks, shift: int) -> Floats:
    """Motion to `shift` frames later: float64 [num_observations, 2]; NaN where it is unknown."""
    found = np.full(tracks.xy.shape, np.nan)
    if tracks.num_observations > shift:
        number = tracks.track
        own = np.flatnonzero(
            (number[shift:] == number[:-shift])
            & (tracks.frame[shift:] - tracks.frame[:-shift] == shift)
        )
        found[own] = tracks.xy[own + shift].astype(np.float64) - tracks.xy[own]
    return found


def _back(steps: Floats, shift: int) -> Floats:
    """The motion from `shift` frames earlier, given the motion to `shift` frames later."""
    found = np.full_like(steps, np.nan)
    found[shift:] = steps[: len(steps) - shift]
    return found


def at_middle_of_read_out(
    xy: NDArray[np.floating],
    velocity: NDArray[np.floating],
    time: NDArray[np.floating],
    read_out: float,
) -> Floats:
    """Positions of points in the middle of the read-out, given those when their row is read.

    Args:
        xy: [n, 2] pixels.
        velocity: [n, 2] pixels per frame.
        time: [n] when their rows are read, from -0.5 for the first row to 0.5 for the last.
        read_out: time from the first row to the last, in frames.
    """
    return np.asarray(xy - read_out * time[:, None] * velocity, dtype=np.float64)


def row_times(xy: NDArray[np.floating], size: tuple[int, int], down: tuple[int, int]) -> Floats:
    """When the rows of points are read, [n], see `at_middle_of_read_out`.

    Args:
        xy: [n, 2] pixels of shown pictures.
        size: (width, height) of these pictures.
        down: direction in shown pictures in which rows are read; (0, 1) is down.
    """
    length = size[0] if down[0] else size[1]
    from_centre = np.asarray(xy, dtype=np.float64) - np.array(size) / 2
    return np.asarray(from_centre @ np.array(down) / length)


def correct_tracks(tracks: Tracks, read_out: float, down: tuple[int, int]) -> Tracks:
    """The tracks that a global shutter would see in the middle of the read-out.

    Args:
        tracks: tracks through all frames.
        read_out: time from the first row to the last, in frames; negative if rows are read from
            the bottom.
        down: as in `row_times`.
    """
    time = row_times(tracks.xy, (tracks.width, tracks.height), down)
    moved = at_middle_of_read_out(tracks.xy, velocities(tracks), time, read_out)
    return replace(tracks, xy=moved.astype(np.float32))
