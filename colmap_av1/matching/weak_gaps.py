"""Gaps between images that motion does not carry over, as the stream itself says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.options import MatchOptions
from colmap_av1.tracks.tracks import Tracks, least_length

# Frames on either side that a frame is compared with.
_NEIGHBOURS = 8
# A frame is weak whose share of inter units is below this, or below this share of its neighbours'
# median. Where a camera jerks, or a picture is blurred, an encoder finds no motion and codes new
# pictures: 2 to 24 % inter units where the frames around have 45 to 95 %; or half of what these
# have, where it finds what only compresses well. Nearly all ordinary frames have more. Below the
# second share of what its neighbours have a frame is surely weak: nearly no ordinary one is.
_LEAST_INTER_SHARE = 0.25
_LEAST_OF_NEIGHBOURS = 0.55
_SURELY_LESS = 0.4


def weak_frames(inter_share: NDArray[np.float32], *, surely: bool = False) -> NDArray[np.bool_]:
    """Find frames whose motion towards the frames before them is not to be trusted.

    Args:
        inter_share: float32 [num_frames] share of inter units in each shown frame, in display
            order.
        surely: leave out those that may be ordinary.

    Returns:
        bool [num_frames]; the first frame is never weak, there is nothing before it.
    """
    weak = np.zeros(len(inter_share), dtype=np.bool_)
    share = _SURELY_LESS if surely else _LEAST_OF_NEIGHBOURS
    for frame in range(1, len(inter_share)):
        around = inter_share[max(1, frame - _NEIGHBOURS) : frame + _NEIGHBOURS + 1]
        usual = float(np.median(around))
        least = max(_LEAST_INTER_SHARE, share * usual)
        weak[frame] = inter_share[frame] < least
    return weak


def weak_gaps(
    inter_share: NDArray[np.float32], frames: NDArray[np.int32], *, surely: bool = False
) -> NDArray[np.bool_]:
    """Find gaps between images that hold a weak frame.

    Args:
        inter_share: as for `weak_frames`.
        frames: int32 [num_images] display index of each image, ascending.
        surely: as for `weak_frames`.

    Returns:
        bool [num_images - 1]: whether motion is weak between image i and image i + 1.
    """
    so_far = np.concatenate([[0], np.cumsum(weak_frames(inter_share, surely=surely))])
    return np.asarray(so_far[frames[1:] + 1] > so_far[frames[:-1] + 1])


def may_link(
    inter_share: NDArray[np.float32],
    frames: NDArray[np.int32],
    tracks: Tracks,
    options: MatchOptions,
) -> bool:
    """Whether pictures may connect images that share no track, or show why there is none.

    A video that is too short for a track needs no pictures to say so.
    """
    links = options.links.links
    lacks_tracks = len(tracks.offsets) == 1 and tracks.num_frames >= least_length(options.tracks)
    return links == "sift" or (
        links == "auto" and (lacks_tracks or bool(weak_gaps(inter_share, frames).any()))
    )
