"""Find the frames of a video in which the camera turns or moves fast, by the lengths of tracks."""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints

# A stretch of frames is fast if few tracks of a frame last for ten more frames or began ten frames
# before: a share below the first value in every frame, and below the second in at least one. In at
# least one frame of the video, it must be below the third. The median share is 11 % on a walk with
# fast turns (`cafe`), and the minimum of such walks is at most 12 %. The minimum is 14 % on a drive
# at 10 frames per second (`street`), whose tracks still connect the images well, and 18 % on a
# hand-held clip (`log_building`).
_LASTING_SHARE, _FEW_LASTING, _FEWEST_LASTING = 0.2, 0.15, 0.13
_LASTING_FRAMES = 10


def fast_frames(tracks: Tracks) -> Bools:
    """Find frames in which most tracks are short, because the camera turns or moves fast.

    Args:
        tracks: all tracks of a video, or a random sample of them, with at least the first and the
            last observation of each. Those selected for matching are longer than usual.

    Returns:
        bool [num_frames].
    """
    count = tracks.num_frames
    first, last = tracks.frame[tracks.offsets[:-1]], tracks.frame[tracks.offsets[1:] - 1]

    def num_seen(first: NDArray[np.int32], last: NDArray[np.int32]) -> Ints:
        change = (
            np.bincount(first, minlength=count) - np.bincount(last + 1, minlength=count)[:count]
        )
        return np.cumsum(change)

    if count <= 2 * _LASTING_FRAMES or tracks.num_tracks == 0:
        return np.zeros(count, np.bool_)
    lasting = last - first >= _LASTING_FRAMES
    first_lasting, last_lasting = first[lasting], last[lasting]
    # All tracks end at a jerk, but they still last on one side of it.
    most = np.maximum(
        num_seen(first_lasting, last_lasting - _LASTING_FRAMES),
        num_seen(first_lasting + _LASTING_FRAMES, last_lasting),
    )
    share = most / np.maximum(num_seen(first, last), 1)
    # Frames before the first and after the last track take the share of the nearest frame with one.
    begin, end = int(first.min()), int(last.max())
    share[:begin], share[end + 1 :] = share[begin], share[end]
    around = np.pad(share, _LASTING_FRAMES // 2, mode="edge")
    usual = np.median(sliding_window_view(around, _LASTING_FRAMES + 1), axis=1)
    if usual.min() >= _FEWEST_LASTING:
        return np.zeros(count, np.bool_)
    below = usual < _LASTING_SHARE
    stretch = np.cumsum(np.diff(below, prepend=False))
    found = below & np.isin(stretch, stretch[usual < _FEW_LASTING])
    fast = np.pad(found, _LASTING_FRAMES)
    return np.asarray(sliding_window_view(fast, 2 * _LASTING_FRAMES + 1).any(axis=1))
