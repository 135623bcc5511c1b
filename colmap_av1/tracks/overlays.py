"""Remove tracks of overlays, such as logos and dashboards, which are not part of the scene."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats
from colmap_av1.util.grouping import groups

# Largest motion of an overlay in pixels: the finest step of a motion vector.
_STILL = 0.125
# A track that stands still is an overlay only if the picture moves by this many pixels meanwhile.
# Distant points stand still for a while when a camera moves sideways.
_MOVED = 4.0
# The median motion into a frame is taken from this many steps on average, if there are more.
_NUM_STEPS = 1000


def remove_overlays(tracks: Tracks, moving: Tracks | None = None) -> Tracks:
    """Remove the tracks that stand still while the picture moves.

    The motion of the picture from frame to frame is the median step of its tracks, or of a sample
    of about a thousand of them. No track is removed while the camera rests.

    Args:
        tracks: any tracks.
        moving: tracks of the same video that show the motion of the picture; None or no tracks:
            the tracks themselves. Needed if `tracks` are observed in distant frames only, because
            then most of those that are left may be overlays.

    Returns:
        The other tracks in the same order; the same object if no track is removed.
    """
    if tracks.num_tracks == 0:
        return tracks
    first, last = tracks.offsets[:-1], tracks.offsets[1:] - 1
    moving = tracks if moving is None or moving.num_tracks == 0 else moving
    travelled = np.concatenate([[0.0], np.cumsum(_picture_motion(moving))])
    moved = travelled[tracks.frame[last] + 1] - travelled[tracks.frame[first] + 1]
    # Only tracks that end where they began can have stood still, and they are few.
    ends_still = _length(tracks.xy[last] - tracks.xy[first]) <= _STILL
    is_overlay = ends_still & (moved >= _MOVED)
    for index in np.flatnonzero(is_overlay):
        xy = tracks.xy[first[index] : last[index] + 1]
        is_overlay[index] = _length(xy - xy[0]).max() <= _STILL
    return tracks.keep_tracks(~is_overlay)


def _picture_motion(tracks: Tracks) -> Floats:
    """Median motion of tracks into each frame in pixels: float64 [num_frames], 0 without tracks."""
    starts = np.zeros(tracks.num_observations, dtype=np.bool_)
    starts[tracks.offsets[:-1]] = True
    # Every n-th step is used. The steps of a track are stored together, so this samples all tracks.
    stride = max(1, tracks.num_observations // (_NUM_STEPS * tracks.num_frames))
    to = np.arange(0, tracks.num_observations, stride)
    to = to[~starts[to]]
    step = _length(tracks.xy[to] - tracks.xy[to - 1])
    frame = tracks.frame[to]
    step /= frame - tracks.frame[to - 1]
    by_frame = [step[own] for own in groups(frame, tracks.num_frames)]
    # For each frame with observations, the number of frames since the previous one with any.
    observed = np.flatnonzero(np.bincount(tracks.frame))
    since = dict(zip(observed[1:].tolist(), np.diff(observed).tolist(), strict=True))
    motion = np.zeros(tracks.num_frames)
    for index in np.unique(frame).tolist():
        middle = len(by_frame[index]) // 2
        motion[index] = np.partition(by_frame[index], middle)[middle] * since[index]
    return motion


def _length(vectors: NDArray[np.float32]) -> NDArray[np.float32]:
    """Lengths of vectors [n, 2]. `np.linalg.norm` takes many times as long for two columns."""
    x, y = vectors[:, 0], vectors[:, 1]
    return np.sqrt(x * x + y * y)
