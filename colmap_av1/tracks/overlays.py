"""Tracks of overlays, which are not part of the scene: logos, dashboards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks, order_by_frame

# Pixels that nothing over the picture moves by: the finest step of a motion vector.
_STILL = 0.125
# Pixels that the picture moves by along a track, before standing still means anything. Far points
# stand still for a while before a camera that moves sideways.
_MOVED = 4.0
# Steps to a frame that their median is taken of, on average, where there are more.
_NUM_STEPS = 1000


def remove_overlays(tracks: Tracks) -> Tracks:
    """Remove the tracks that stand still while the picture moves.

    A picture moves by the median step of its tracks, of a thousand or more where there are so many,
    from frame to frame. Where the camera rests nothing is left out.

    Args:
        tracks: any tracks.

    Returns:
        The other tracks in their former order; the same object where nothing is left out.
    """
    if tracks.num_tracks == 0:
        return tracks
    first, last = tracks.offsets[:-1], tracks.offsets[1:] - 1
    travelled = np.concatenate([[0.0], np.cumsum(_picture_motion(tracks))])
    moved = travelled[tracks.frame[last] + 1] - travelled[tracks.frame[first] + 1]
    # Few tracks end where they began, and only these can have stood still.
    ends_still = _length(tracks.xy[last] - tracks.xy[first]) <= _STILL
    over_picture = ends_still & (moved >= _MOVED)
    for index in np.flatnonzero(over_picture):
        xy = tracks.xy[first[index] : last[index] + 1]
        over_picture[index] = _length(xy - xy[0]).max() <= _STILL
    return tracks.keep_tracks(~over_picture)


def _picture_motion(tracks: Tracks) -> NDArray[np.float64]:
    """Median motion of tracks into each frame in pixels: float64 [num_frames], 0 without any."""
    starts = np.zeros(tracks.num_observations, dtype=np.bool_)
    starts[tracks.offsets[:-1]] = True
    # Every n-th: steps of a track follow each other, so all tracks have their part.
    stride = max(1, tracks.num_observations // (_NUM_STEPS * tracks.num_frames))
    to = np.arange(0, tracks.num_observations, stride)
    to = to[~starts[to]]
    step = _length(tracks.xy[to] - tracks.xy[to - 1])
    frame = tracks.frame[to]
    step /= frame - tracks.frame[to - 1]
    count = np.bincount(frame, minlength=tracks.num_frames)
    by_frame = np.split(step[order_by_frame(frame, tracks.num_frames)], np.cumsum(count)[:-1])
    # Frames since the last one that any observation is kept in.
    observed = np.flatnonzero(np.bincount(tracks.frame))
    since = dict(zip(observed[1:].tolist(), np.diff(observed).tolist(), strict=True))
    motion = np.zeros(tracks.num_frames)
    for index in np.flatnonzero(count).tolist():
        middle = len(by_frame[index]) // 2
        motion[index] = np.partition(by_frame[index], middle)[middle] * since[index]
    return motion


def _length(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Length of each of [n, 2] vectors; NumPy's own norm takes many times as long for two."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.sqrt(x * x + y * y)
