"""Tracks of what does not belong to the scene but lies over the picture: logos, dashboards."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks import Tracks, keep_observations

# Pixels that nothing over the picture moves by: the finest step of a motion vector.
_STILL = 0.125
# Pixels that the picture moves by along a track, before standing still tells anything. Far points
# stand still for a while before a camera that moves sideways.
_MOVED = 4.0


def remove_overlays(tracks: Tracks) -> Tracks:
    """Leave out the tracks that stand still while the picture moves.

    A picture moves by the median step of all tracks, from frame to frame. Where the camera
    rests nothing is left out.

    Args:
        tracks: any tracks.

    Returns:
        The other tracks in their former order; the same object where nothing is left out.
    """
    if len(tracks.offsets) == 1:
        return tracks
    first, last = tracks.offsets[:-1], tracks.offsets[1:] - 1
    lengths = np.diff(tracks.offsets)
    distance = np.linalg.norm(tracks.xy - np.repeat(tracks.xy[first], lengths, axis=0), axis=1)
    still = np.maximum.reduceat(distance, first) <= _STILL
    travelled = np.concatenate([[0.0], np.cumsum(_picture_motion(tracks))])
    moved = travelled[tracks.frame[last] + 1] - travelled[tracks.frame[first] + 1]
    return keep_observations(tracks, np.repeat(~still | (moved < _MOVED), lengths))


def _picture_motion(tracks: Tracks) -> NDArray[np.float64]:
    """Median step in pixels that leads to each frame: float64 [num_frames], 0 where none does."""
    track = np.repeat(np.arange(len(tracks.offsets) - 1), np.diff(tracks.offsets))
    within = track[1:] == track[:-1]
    step = np.linalg.norm(np.diff(tracks.xy, axis=0)[within], axis=1)
    step /= np.diff(tracks.frame)[within]
    frame = tracks.frame[1:][within]
    order = np.lexsort((step, frame))
    count = np.bincount(frame, minlength=tracks.num_frames)
    start = np.cumsum(count) - count
    has = count > 0
    motion = np.zeros(tracks.num_frames)
    motion[has] = step[order][(start + count // 2)[has]]
    return motion
