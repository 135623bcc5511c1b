"""Find gaps: neighbouring images of a video that motion connects badly.

Before images are matched, a low share of inter-coded units shows that the encoder found no motion.
After matching, the number of matches across a gap shows how well its images are connected.
"""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.names import natural_order
from colmap_av1.matching.image_matches import MatchedImages, used_pairs
from colmap_av1.options import LinkOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.spread import evenly_spread

# Number of frames on either side that a frame is compared with.
_NEIGHBOURS = 8
# A frame has a low inter share if it is below the first value, or below the second value times the
# median of its neighbours. If the camera jerks or a picture is blurred, the encoder finds no motion
# and codes the picture anew: 2 to 24 % inter units where the neighbours have 45 to 95 %, or half of
# their share if it uses vectors that merely compress well. Nearly all ordinary frames have more.
# Nearly no ordinary frame is below the third value times the median.
_LEAST_INTER_SHARE = 0.25
_LEAST_OF_NEIGHBOURS = 0.55
_CERTAINLY_LESS = 0.4
# With this median share of inter units, motion is trusted. 85 % is usual; a drive has 50 to 60 %.
_HIGH_INTER_SHARE = 0.6
# Number of gaps to probe if the share is lower.
_NUM_PROBES = 6
# The motion of a video needs no probes if neighbouring images have this many matches and this share
# of inliers (medians). A drive has 2,000 and 99.8 %. A camera that is too fast for the encoder's
# motion search gives 20 matches, or 150 with 90 % inliers.
_RIGID_MATCHES = 300
_RIGID_SHARE = 0.98
# A gap has few matches if they are fewer than this share of the usual number. Camera jerks leave 5
# to 37 %, clips without jerks have 53 % and more, with matches from motion or from SIFT. Models
# that COLMAP's mappers bent at a jerk by 0.7 to 1 % of their extent had 5 to 25 %.
_FEW = 0.4
# The usual number comes from up to this many gaps before and after.
_NEARBY = 10
# A stretch of frames is fast if few tracks of a frame last for ten more frames or began ten frames
# before: a share below the first value in every frame, and below the second in at least one. The
# median share is 12 % on a walk with fast turns (`cafe`). The minimum is 16 % on a drive at 10
# frames per second (`street`), whose tracks still connect the images well, and 23 % on a hand-held
# clip (`log_building`).
_LASTING_SHARE, _FEW_LASTING = 0.2, 0.15
_LASTING_FRAMES = 10
# Number of gaps that a warning names.
_NUM_NAMED = 3

GapReason = Literal["low inter share", "few tracks", "contradicted", "no overlap"]


@dataclass(frozen=True)
class Gap:
    """Two neighbouring images of a video that motion connects badly.

    Attributes:
        before: name of the last image before the gap.
        after: name of the first image after it.
        reasons: why. low inter share: the encoder found little motion. contradicted: the pictures
            contradict the motion or do not confirm it, so its matches are left out. few tracks: a
            mapper may split the images there. no overlap: nothing connects the two images.
        frames: the frames of both images, counted through all videos; None if not known.
        share: matches across the gap over the usual number nearby; 1 if not measured.
    """

    before: str
    after: str
    reasons: tuple[GapReason, ...]
    frames: tuple[int, int] | None = None
    share: float = 1.0


def low_inter_frames(
    inter_share: NDArray[np.float32], *, certain: bool = False
) -> NDArray[np.bool_]:
    """Find frames whose motion is doubtful because few units are inter coded.

    Args:
        inter_share: float32 [num_frames] share of inter units of each shown frame, in display
            order.
        certain: leave out frames that may be ordinary.

    Returns:
        bool [num_frames]; False for the first frame, which has no motion.
    """
    low = np.zeros(len(inter_share), dtype=np.bool_)
    if len(low) < 2:
        return low
    share = _CERTAINLY_LESS if certain else _LEAST_OF_NEIGHBOURS
    own = inter_share[1:]
    around = sliding_window_view(
        np.pad(own, _NEIGHBOURS, constant_values=np.nan), 2 * _NEIGHBOURS + 1
    )
    usual = np.nanmedian(around, axis=1).astype(np.float64)
    low[1:] = own < np.maximum(_LEAST_INTER_SHARE, share * usual).astype(own.dtype)
    return low


def low_inter_gaps(
    inter_share: NDArray[np.float32], frames: NDArray[np.int32], *, certain: bool = False
) -> NDArray[np.bool_]:
    """Find gaps between images that contain a frame with a low inter share.

    Args:
        inter_share: as for `low_inter_frames`.
        frames: int32 [num_images] display index of each image, ascending.
        certain: as for `low_inter_frames`.

    Returns:
        bool [num_images - 1] for the gap between image i and image i + 1.
    """
    so_far = np.concatenate([[0], np.cumsum(low_inter_frames(inter_share, certain=certain))])
    return np.asarray(so_far[frames[1:] + 1] > so_far[frames[:-1] + 1])


def fast_frames(tracks: Tracks) -> NDArray[np.bool_]:
    """Find frames in which most tracks are short, because the camera turns or moves fast.

    Args:
        tracks: all tracks of a video, not a selection.

    Returns:
        bool [num_frames].
    """
    count = tracks.num_frames
    first, last = tracks.frame[tracks.offsets[:-1]], tracks.frame[tracks.offsets[1:] - 1]

    def num_seen(first: NDArray[np.int32], last: NDArray[np.int32]) -> NDArray[np.int64]:
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
    below = usual < _LASTING_SHARE
    stretch = np.cumsum(np.diff(below, prepend=False))
    found = below & np.isin(stretch, stretch[usual < _FEW_LASTING])
    fast = np.pad(found, _LASTING_FRAMES)
    return np.asarray(sliding_window_view(fast, 2 * _LASTING_FRAMES + 1).any(axis=1))


def should_examine_pictures(
    inter_share: NDArray[np.float32],
    frames: NDArray[np.int32],
    tracks: Tracks,
    links: LinkOptions,
    min_length: int,
) -> bool:
    """Whether pictures are examined if no two images share enough tracks.

    The pictures may connect the images, or show why there are no tracks. That reason is clear
    without them if the video is shorter than `min_length`, the fewest frames of a track.
    """
    lacks_tracks = tracks.num_tracks == 0 and tracks.num_frames >= min_length
    return links.links == "sift" or (
        links.links == "auto" and (lacks_tracks or bool(low_inter_gaps(inter_share, frames).any()))
    )


def probed_gaps(
    inter_share: NDArray[np.float32], low: NDArray[np.bool_], options: LinkOptions
) -> list[int]:
    """Choose gaps at which to compare motion with the pictures, to decide whether to trust it.

    Empty if most units are inter-coded. If the camera is too fast for the encoder's motion search,
    the encoder uses whatever vectors compress well, which need not be motion.
    """
    if options.links == "none" or len(inter_share) < 2:
        return []
    if float(np.median(inter_share[1:])) >= _HIGH_INTER_SHARE:
        return []
    others = np.flatnonzero(~low)
    return [int(gap) for gap in others[evenly_spread(len(others), _NUM_PROBES, rounded=True)]]


@dataclass(frozen=True)
class SuspectGaps:
    """Gaps between images of all videos whose motion may be wrong.

    Attributes:
        certain: bool [num_images - 1] gaps with a low inter share.
        maybe: bool [num_images - 1] gaps with a lowered inter share that may be ordinary.
        probes: other gaps, a sample of all gaps of their video.
    """

    certain: NDArray[np.bool_]
    maybe: NDArray[np.bool_]
    probes: list[int]


def suspect_gaps(
    image_set: ImageSet,
    matched: MatchedImages,
    inter_share: NDArray[np.float32],
    options: LinkOptions,
) -> SuspectGaps:
    """Find the gaps whose motion may be wrong; the gap between two videos is never one of them."""
    certain = np.zeros(max(len(image_set.sequence) - 1, 0), dtype=np.bool_)
    maybe, probes = np.zeros_like(certain), list[int]()
    for video in range(len(image_set.videos)):
        share = inter_share[image_set.first_frame[video] : image_set.first_frame[video + 1]]
        images, frames = image_set.images_of(video), image_set.of_video(video).frames
        low, own = low_inter_gaps(share, frames), slice(images.start, images.stop - 1)
        certain[own] = low_inter_gaps(share, frames, certain=True)
        maybe[own] = low & ~certain[own]
        if not _is_rigid(matched, images):
            probes += [images.start + gap for gap in probed_gaps(share, low, options)]
    return SuspectGaps(certain, maybe, probes)


def _is_rigid(matched: MatchedImages, images: range) -> bool:
    """Whether the motion between neighbouring images of a video is that of a rigid scene."""
    counts = [
        (len(matches), len(geometry.inlier_matches))
        for (i, j), matches, geometry in zip(
            matched.pairs.tolist(), matched.matches, matched.geometries, strict=True
        )
        if i in images and j == i + 1
    ]
    if 2 * len(counts) < len(images):
        return False
    num_matches, num_inliers = np.array(counts).T
    share = np.median(num_inliers / np.maximum(num_matches, 1))
    return bool(np.median(num_matches) >= _RIGID_MATCHES and share >= _RIGID_SHARE)


def few_match_gaps(
    pairs: NDArray[np.integer],
    num_inliers: NDArray[np.integer],
    names: Sequence[str],
    videos: Sequence[Hashable],
) -> tuple[Gap, ...]:
    """Find gaps with far fewer matches across them than across the gaps before and after.

    Gaps without any matches are left out: the images on either side become separate models.

    Args:
        pairs: integers [m, 2] image indices of the pairs that mappers use.
        num_inliers: integers [m] verified matches of each pair.
        names: names of the images; their natural order is the order in time.
        videos: identifies the video of each image, see `videos_of`.
    """
    rows: dict[Hashable, list[int]] = {}
    for i in natural_order(names):
        rows.setdefault(videos[i], []).append(i)
    # Order the images by video, so that no pair of one video crosses a gap of another.
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
    found: list[Gap] = []
    for own in rows.values():
        share = _share_of_usual(across[place[own[0]] : place[own[-1]]])
        for is_few, gaps in groupby(range(len(share)), key=lambda g: share[g] < _FEW):
            if is_few:
                together = list(gaps)
                first, last = own[together[0]], own[together[-1] + 1]
                least = float(share[together].min())
                found.append(Gap(names[first], names[last], ("few tracks",), share=least))
    return tuple(found)


def _share_of_usual(across: NDArray[np.int64]) -> NDArray[np.float64]:
    """Matches across each gap over the most across nearby gaps, on the side where that is less.

    The comparison stops at a gap without matches, because another model begins there. The share of
    such a gap is 1.
    """
    share = np.ones(len(across))
    joined = np.flatnonzero(across)
    for run in np.split(joined, np.flatnonzero(np.diff(joined) > 1) + 1):
        counts = across[run]
        for k, gap in enumerate(run.tolist()):
            before = counts[max(0, k - _NEARBY) : k + 1].max()
            after = counts[k : k + _NEARBY + 1].max()
            share[gap] = counts[k] / min(before, after)
    return share


def few_matches_warning(gaps: Sequence[Gap]) -> str | None:
    """Warn of gaps with few matches; None if there are none."""
    if not gaps:
        return None
    shown = ", ".join(f"'{gap.before}' and '{gap.after}'" for gap in gaps[:_NUM_NAMED])
    more = len(gaps) - _NUM_NAMED
    others = f" and at {more} more {'place' if more == 1 else 'places'}" if more > 0 else ""
    least = min(gap.share for gap in gaps)
    return (
        f"few matches, down to {least:.0%} of the usual number, between {shown}{others}, where the "
        "camera jerks or frames are missing: COLMAP's mappers may bend the model there by one per "
        "cent of its extent without any other sign; run reconstruct instead, which uses the "
        "pictures, or film more slowly"
    )


def matching_warning(matched: MatchedImages, image_set: ImageSet) -> str | None:
    """Warn of gaps with few matches between images of a video."""
    used, counts = used_pairs(matched)
    gaps = few_match_gaps(
        matched.pairs[used], counts[used], image_set.images.names, image_set.sequence.tolist()
    )
    return few_matches_warning(gaps)
