"""Find gaps across which the images of a video have few matches, of any origin."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.names import natural_order
from colmap_av1.matching.gaps import Gap
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.util.grouping import sums_beside_gaps

# A gap has few matches if they are fewer than this share of the usual number. Camera jerks leave 5
# to 37 %, clips without jerks have 53 % and more, with matches from motion or from SIFT. Models
# that COLMAP's mappers bent at a jerk by 0.7 to 1 % of their extent had 5 to 25 %.
_FEW = 0.4
# There is no gap if the images near it have this share of their matches or more with images of
# other folders, which hold them together: photos of a scene that a video shows, for example.
_SHARED = 0.3
# The usual number comes from up to this many gaps before and after.
_NEARBY = 10
# Number of gaps that a warning names.
_NUM_NAMED = 3


def few_match_gaps(
    pairs: NDArray[np.integer],
    num_inliers: NDArray[np.integer],
    names: Sequence[str],
    videos: Sequence[Hashable],
    *,
    order: Sequence[int] | None = None,
) -> tuple[Gap, ...]:
    """Find gaps with far fewer matches across them than across the gaps before and after.

    Gaps without any matches are left out: the images on either side become separate models. So are
    those of images that are held together by the images of other videos.

    Args:
        pairs: integers [m, 2] image indices of the pairs that mappers use.
        num_inliers: integers [m] verified matches of each pair.
        names: names of the images.
        videos: identifies the video of each image, see `videos_of`.
        order: indices of the images in the order of time; None: the natural order of their names.
    """
    rows: dict[Hashable, list[int]] = {}
    for i in order if order is not None else natural_order(names):
        rows.setdefault(videos[i], []).append(i)
    # Order the images by video, so that no pair of one video crosses a gap of another.
    by_video = [i for own in rows.values() for i in own]
    rank, row = np.empty(len(names), np.int64), np.empty(len(names), np.int64)
    rank[by_video] = np.arange(len(by_video))
    row[by_video] = np.repeat(np.arange(len(rows)), [len(own) for own in rows.values()])
    inside = row[pairs[:, 0]] == row[pairs[:, 1]]
    ends = np.sort(rank[pairs[inside]], axis=1)
    change = np.zeros(len(names), dtype=np.int64)
    np.add.at(change, ends[:, 0], num_inliers[inside])
    np.subtract.at(change, ends[:, 1], num_inliers[inside])
    across = np.cumsum(change)
    image, count = rank[pairs].ravel(), np.repeat(num_inliers, 2)
    every = np.bincount(image, count, minlength=len(names))
    outside = np.bincount(image, count * np.repeat(~inside, 2), minlength=len(names))
    found: list[Gap] = []
    for own in rows.values():
        first, last = rank[own[0]], rank[own[-1]]
        share = _share_of_usual(across[first:last])
        beside = [sums_beside_gaps(n[first : last + 1], _NEARBY) for n in (outside, every)]
        share[beside[0] >= _SHARED * beside[1]] = 1.0
        for is_few, gaps in groupby(range(len(share)), key=lambda g: share[g] < _FEW):
            if is_few:
                together = list(gaps)
                before, after = names[own[together[0]]], names[own[together[-1] + 1]]
                least = float(share[together].min())
                found.append(Gap(before, after, ("few tracks",), share=least))
    return tuple(found)


def _share_of_usual(across: Ints) -> Floats:
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
        "cent of its extent without another warning; run reconstruct instead, which uses the "
        "pictures, or film more slowly"
    )


def matching_warning(matched: MatchedImages, image_set: ImageSet) -> str | None:
    """Warn of gaps with few matches between images of a video."""
    names, used = image_set.images.names, matched.is_used
    gaps = few_match_gaps(
        matched.pairs[used],
        matched.num_inliers[used],
        names,
        image_set.sequence.tolist(),
        order=range(len(names)),
    )
    return few_matches_warning(gaps)
