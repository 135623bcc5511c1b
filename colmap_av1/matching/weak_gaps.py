"""Gaps between images that little carries over: by what the stream says, and by what is matched."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from colmap_av1.images.names import natural_order
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
# A gap is thin that less than this share of the usual matches crosses: where a camera jerks 5 to
# 37 % do, on clips without jerks 53 % and more, matched along motion or by SIFT. Models that
# COLMAP's mappers bent there by 0.7 to 1 % of their extent, without any other sign, had 5 to 25 %.
_THIN = 0.4
# What is usual is what crosses gaps up to so many images before, and after.
_BESIDE = 10
# Thin gaps that a warning names.
_NUM_NAMED = 3


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
    if len(weak) < 2:
        return weak
    share = _SURELY_LESS if surely else _LEAST_OF_NEIGHBOURS
    own = inter_share[1:]
    around = sliding_window_view(
        np.pad(own, _NEIGHBOURS, constant_values=np.nan), 2 * _NEIGHBOURS + 1
    )
    usual = np.nanmedian(around, axis=1).astype(np.float64)
    weak[1:] = own < np.maximum(_LEAST_INTER_SHARE, share * usual).astype(own.dtype)
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
    lacks_tracks = tracks.num_tracks == 0 and tracks.num_frames >= least_length(options.tracks)
    return links == "sift" or (
        links == "auto" and (lacks_tracks or bool(weak_gaps(inter_share, frames).any()))
    )


@dataclass(frozen=True)
class ThinGap:
    """A gap between images in the order of a video, that few matches cross.

    Attributes:
        before: name of the last image before it.
        after: name of the first image after it; images between are matched little with either.
        share: matches across it, as a share of what crosses gaps nearby on both sides.
    """

    before: str
    after: str
    share: float


def thin_gaps(
    pairs: NDArray[np.integer],
    num_inliers: NDArray[np.integer],
    names: Sequence[str],
    videos: Sequence[Hashable],
) -> tuple[ThinGap, ...]:
    """Find gaps that far fewer matches cross than those before and after them.

    Those that nothing crosses are left out: the images on either side become separate models.

    Args:
        pairs: integers [m, 2] indices of images, of pairs that mappers use.
        num_inliers: integers [m] their verified matches.
        names: of the images; their natural order is that of time.
        videos: of each image what tells its video, see `video_of`.
    """
    rows: dict[Hashable, list[int]] = {}
    for i in natural_order(names):
        rows.setdefault(videos[i], []).append(i)
    # One video after the other, so that no pair of one of them crosses a gap of another.
    order = [i for own in rows.values() for i in own]
    place, row = np.empty(len(names), np.int64), np.empty(len(names), np.int64)
    place[order] = np.arange(len(order))
    row[order] = np.repeat(np.arange(len(rows)), [len(own) for own in rows.values()])
    inside = row[pairs[:, 0]] == row[pairs[:, 1]]
    ends = np.sort(place[pairs[inside]], axis=1)
    change = np.zeros(len(names), dtype=np.int64)
    np.add.at(change, ends[:, 0], num_inliers[inside])
    np.subtract.at(change, ends[:, 1], num_inliers[inside])
    across = np.cumsum(change)
    found: list[ThinGap] = []
    for own in rows.values():
        share = _share_of_usual(across[place[own[0]] : place[own[-1]]])
        for thin, gaps in groupby(range(len(share)), key=lambda g: share[g] < _THIN):
            if thin:
                together = list(gaps)
                first, last = own[together[0]], own[together[-1] + 1]
                found.append(ThinGap(names[first], names[last], float(share[together].min())))
    return tuple(found)


def _share_of_usual(across: NDArray[np.int64]) -> NDArray[np.float64]:
    """Matches across each gap over those across gaps nearby, on the side where these are fewer.

    What lies beyond a gap that nothing crosses is another model; its own share is 1.
    """
    share = np.ones(len(across))
    joined = np.flatnonzero(across)
    for run in np.split(joined, np.flatnonzero(np.diff(joined) > 1) + 1):
        counts = across[run]
        for k, gap in enumerate(run.tolist()):
            before = counts[max(0, k - _BESIDE) : k + 1].max()
            after = counts[k : k + _BESIDE + 1].max()
            share[gap] = counts[k] / min(before, after)
    return share


def thin_gap_warning(gaps: Sequence[ThinGap]) -> str | None:
    """What the user should know of a model whose images few matches join at some gaps."""
    if not gaps:
        return None
    shown = ", ".join(f"'{gap.before}' and '{gap.after}'" for gap in gaps[:_NUM_NAMED])
    more = len(gaps) - _NUM_NAMED
    others = f" and at {more} more {'place' if more == 1 else 'places'}" if more > 0 else ""
    least = min(gap.share for gap in gaps)
    return (
        f"few matches, down to {least:.0%} of what is usual, cross between {shown}{others}, where "
        "the camera jerks or frames are missing: without another sign, models of COLMAP's mappers "
        "may be off by a per cent of their extent there; reconstruct the video instead, which "
        "follows its pictures, or film it more slowly"
    )
