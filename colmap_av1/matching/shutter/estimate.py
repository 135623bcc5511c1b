"""Estimate the read-out time of a rolling shutter by minimizing epipolar errors of tracks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from colmap_av1.matching.focal import estimate_focal_length, lowest, pose_loss
from colmap_av1.matching.pairs import ImageKeypoints, pair_matches
from colmap_av1.tracks.shutter import at_middle_of_read_out, row_times, velocities
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats
from colmap_av1.util.grouping import with_equal_keys
from colmap_av1.util.spread import evenly_spread

# Read-out times to try, in frame periods; negative if rows are read from the bottom.
_TRIED = np.linspace(-1.0, 1.0, 17)
# Number of frame pairs, distances in frames within a pair, and matches used per pair.
_NUM_PAIRS = 48
_GAPS = (4, 8, 16)
_NUM_MATCHES = 300
_MIN_MATCHES, _MIN_PAIRS = 80, 12
# Spread of the motion of a pair, in pixels, that is enough parallax or rotation.
_LEAST_SPREAD = 4.0
# An estimate is accepted if it fits better than a read-out time of 0 by this many standard errors,
# if even and odd pairs agree on it to within this share of a frame period, and if it is longer than
# this share of a frame period.
_LEAST_SIGNIFICANCE = 4.0
_LARGEST_DIFFERENCE = 0.15
_LEAST_READ_OUT = 0.05
# Added to a loss before its logarithm, which keeps the logarithm finite.
_LEAST_LOSS = 1e-3


@dataclass(frozen=True)
class ReadOut:
    """An estimated read-out time.

    Attributes:
        frames: time from the first row to the last in frame periods; negative if rows are read
            from the bottom.
        error: half the difference of the estimates from even and from odd pairs.
        significance: improvement of the loss over a read-out time of 0, in standard errors.
    """

    frames: float
    error: float
    significance: float


@dataclass(frozen=True)
class _View:
    """Matches of a pair of frames: pixels from the centre, velocities, times in the read-out."""

    xy: tuple[Floats, Floats]
    velocity: tuple[Floats, Floats]
    time: tuple[Floats, Floats]

    def corrected(self, read_out: float) -> tuple[Floats, Floats]:
        a, b = (
            np.ascontiguousarray(at_middle_of_read_out(xy, velocity, time, read_out))
            for xy, velocity, time in zip(self.xy, self.velocity, self.time, strict=True)
        )
        return a, b


def estimate_read_out(
    tracks: Tracks, down: tuple[int, int], focal_length: float | None, seed: int = 0
) -> ReadOut | str:
    """Estimate the time in which a rolling shutter reads the rows of a picture.

    For a range of times, positions are moved to the middle of the read-out by their velocities, and
    relative poses are fitted to pairs of frames. The true time minimizes the geometric mean of the
    robust epipolar losses if the motion changes along the video. An even pan or walk distorts all
    pictures alike, so it does not determine the time.

    Args:
        tracks: tracks through all frames.
        down: direction in which rows are read, see `row_times`.
        focal_length: in pixels; if None, it is estimated from the tracks.
        seed: the random seed.

    Returns:
        The read-out time, or the reason why it is not observable.
    """
    views = _views(tracks, down, seed)
    if len(views) < _MIN_PAIRS:
        return "too few frames share enough tracks, or nothing moves"
    found: ReadOut | str = "the focal length is not observable from the tracks"
    read_out = 0.0
    for _ in range(1 if focal_length is not None else 2):
        focal = focal_length or _focal_length(tracks, views, read_out, seed)
        found = _least_loss(views, focal, seed) if focal is not None else found
        if isinstance(found, str):
            return found
        read_out = found.frames
    assert isinstance(found, ReadOut)
    if abs(found.frames) < _LEAST_READ_OUT or found.significance < _LEAST_SIGNIFICANCE:
        return "no read-out time fits the tracks better than a global shutter"
    if found.error > _LARGEST_DIFFERENCE / 2:
        return "parts of the video give different read-out times"
    return found


def _views(tracks: Tracks, down: tuple[int, int], seed: int) -> list[_View]:
    """Pairs of frames along the video, far enough apart for enough motion if possible."""
    rng = np.random.default_rng(seed)
    speed = velocities(tracks)
    time = row_times(tracks.xy, (tracks.width, tracks.height), down)
    centre = np.array([tracks.width, tracks.height]) / 2
    by_frame, track = tracks.by_frame(), tracks.track
    views = []
    last = tracks.num_frames - 1 - _GAPS[0]
    for first in evenly_spread(max(last, 0) + 1, _NUM_PAIRS):
        found = None
        for gap in _GAPS:
            if first + gap >= tracks.num_frames:
                break
            shared = with_equal_keys(track, by_frame[first], by_frame[first + gap])
            if len(shared[0]) < _MIN_MATCHES:
                break
            found = shared
            motion = tracks.xy[found[1]] - tracks.xy[found[0]]
            spread = np.abs(motion - np.median(motion, axis=0)).sum(axis=1)
            if np.median(spread) >= _LEAST_SPREAD:
                break
        if found is None:
            continue
        some = rng.permutation(len(found[0]))[:_NUM_MATCHES]
        a, b = found[0][some], found[1][some]
        views.append(
            _View(
                (
                    tracks.xy[a].astype(np.float64) - centre,
                    tracks.xy[b].astype(np.float64) - centre,
                ),
                (speed[a].astype(np.float64), speed[b].astype(np.float64)),
                (time[a].astype(np.float64), time[b].astype(np.float64)),
            )
        )
    return views


def _focal_length(
    tracks: Tracks, views: Sequence[_View], read_out: float, seed: int
) -> float | None:
    """Estimate the focal length from the views' matches, corrected for a read-out time."""
    size = tracks.width, tracks.height
    centre = np.array(size) / 2
    keypoints: list[ImageKeypoints] = []
    for view in views:
        for xy in view.corrected(read_out):
            number = np.arange(len(xy), dtype=np.int64)
            keypoints.append(ImageKeypoints((xy + centre).astype(np.float32), number))
    pairs = np.arange(len(keypoints), dtype=np.int32).reshape(-1, 2)
    matches = [pair_matches(keypoints[i], keypoints[j]) for i, j in pairs]
    return estimate_focal_length(keypoints, pairs, matches, size, seed=seed)


def _least_loss(views: Sequence[_View], focal_length: float, seed: int) -> ReadOut | str:
    """The read-out time with the smallest loss, or the reason why there is none."""
    loss = np.array(
        [
            [
                np.log(pose_loss(*view.corrected(float(t)), focal_length, seed) + _LEAST_LOSS)
                for t in _TRIED
            ]
            for view in views
        ]
    )
    found, *halves = (lowest(_TRIED, part.mean(axis=0)) for part in (loss, loss[::2], loss[1::2]))
    if found is None or None in halves:
        return "the loss has no minimum within the read-out times tried"
    at_best = np.array([np.interp(found, _TRIED, row) for row in loss])
    at_none = loss[:, len(_TRIED) // 2]
    gain = at_none - at_best
    significance = float(gain.mean() / max(gain.std(ddof=1) / np.sqrt(len(gain)), 1e-12))
    one, two = halves
    assert one is not None
    assert two is not None
    return ReadOut(found, abs(one - two) / 2, significance)
