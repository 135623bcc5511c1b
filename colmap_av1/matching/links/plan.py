"""Plan which pictures are examined: at gaps, for loop closures, and between videos."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.gaps import SuspectGaps, low_inter_gaps, probed_gaps
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.options import LinkOptions
from colmap_av1.util.arrays import Bools, Ints

# Images to examine on either side of a gap, by their distance from it. The nearest have the most in
# common, the others determine the scale.
_AROUND_GAP = (0, 1, 2, 4, 7)
# While the camera moves fast, too few tracks last to determine the scale. All pictures are then
# matched with their neighbours, as in COLMAP's sequential matcher, and every n-th image is searched
# for loop closures.
_LOOP_STEP = 2
# Distances of the images that a first look compares with the motion: most suspect gaps are
# ordinary.
_FIRST_LOOK = (0, 2)
# Loop closures are searched in images at this share of the span that tracks reach ...
_LOOP_SHARE = 0.2
# ... in videos longer than that span by this factor, with at least this many images.
_LONG = 8
_LEAST_IMAGES = 120
# Smallest distance between these images, which bounds the time, and their smallest number in each
# of several videos.
_LEAST_STEP = 3
_LEAST_LOOP_IMAGES = 12
# Largest number of images of each video, and of photos, that are compared with those of other
# videos if all SIFT features are extracted, which takes twice as long as light ones.
_MAX_FULL_IMAGES = 12


@dataclass(frozen=True)
class Plan:
    """Which pictures are examined.

    Attributes:
        gaps: int64 [n] gaps that motion does not bridge, by the image before each gap.
        around: the images whose pictures are matched across each gap.
        loop: images in which loop closures are searched.
        between: images that are compared with those of other videos and photos.
        fast: stretches of images in which the camera moves fast; all are matched with their
            neighbours.
        effort: effort of feature extraction.
    """

    gaps: Ints
    around: list[list[int]]
    loop: list[int]
    between: list[int]
    fast: tuple[range, ...] = ()
    effort: Literal["light", "full"] = "light"

    @property
    def wanted(self) -> list[int]:
        """All images whose pictures are needed, ascending."""
        return sorted(
            {
                image
                for images in [*self.around, *self.fast, self.loop, self.between]
                for image in images
            }
        )


def images_to_link(
    inter_share: NDArray[np.float32], frames: NDArray[np.int32], options: LinkOptions
) -> Bools:
    """Predict, before matching, which images of a video need pictures because of suspect gaps.

    Args:
        inter_share: float32 [num_frames], see `TrackedVideo`.
        frames: int32 [num_images] frame of each image.
        options: whether images are linked.

    Returns:
        bool [num_images]; all True if the motion has to be probed.
    """
    chosen = np.zeros(len(frames), dtype=np.bool_)
    low = low_inter_gaps(inter_share, frames)
    certain = low_inter_gaps(inter_share, frames, certain=True)
    if options.links != "none":
        for gap in np.flatnonzero(low).tolist():
            around = _AROUND_GAP if certain[gap] else _FIRST_LOOK
            chosen[_images_around(gap, range(len(frames)), around)] = True
    if probed_gaps(inter_share, low, options):
        chosen[:] = True
    return chosen


def _images_around(gap: int, images: range, distances: Sequence[int] = _AROUND_GAP) -> list[int]:
    """Images of a video whose pictures are matched across a gap."""
    found = {gap - d for d in distances} | {gap + 1 + d for d in distances}
    return sorted(found & set(images))


def first_look(suspect: SuspectGaps, image_set: ImageSet) -> Plan:
    """Plan to examine a few images on either side of each suspect gap."""
    around = {
        gap: _images_around(gap, image_set.images_of(int(image_set.sequence[gap])), _FIRST_LOOK)
        for gap in np.flatnonzero(suspect.maybe).tolist()
    }
    around |= {gap: [gap, gap + 1] for gap in suspect.probes if gap not in around}
    gaps = sorted(around)
    return Plan(np.array(gaps, np.int64), [around[gap] for gap in gaps], [], [])


def plan_links(
    image_set: ImageSet,
    matched: MatchedImages,
    gaps: Bools,
    images_apart: float,
    options: LinkOptions,
    *,
    fast: Bools,
) -> Plan:
    """Choose the pictures to examine at gaps, for loop closures in long videos, and between videos.

    Args:
        image_set: the images.
        matched: the images, matched along tracks.
        gaps: bool [num_images - 1] gaps that motion does not bridge.
        images_apart: see `link_images`.
        options: whether and where images are linked.
        fast: bool [n] images of the videos around which the camera moves fast, see `fast_frames`.
    """
    if options.links == "none":
        return Plan(np.empty(0, np.int64), [], [], [])
    chosen = np.flatnonzero(gaps)
    around = [
        _images_around(gap, image_set.images_of(int(image_set.sequence[gap])))
        for gap in chosen.tolist()
    ]
    stretches = _stretches(fast, image_set)
    loop: list[int] = []
    for video in range(len(image_set.videos)):
        images = image_set.images_of(video)
        least = max(_LONG * reach(matched, images), _LEAST_IMAGES / images_apart)
        if options.links != "auto" or len(images) >= least:
            loop += _spread_images(image_set, matched, video, images_apart)
    if stretches:
        loop = sorted({*loop, *(i for own in stretches for i in own[::_LOOP_STEP])})
    between: list[int] = []
    if image_set.num_sequences > 1:
        between = spread_over_videos(image_set, matched, images_apart)
        between += image_set.photos
    return Plan(
        chosen,
        around,
        loop,
        between,
        stretches,
        effort="full" if stretches else "light",
    )


def _stretches(chosen: Bools, image_set: ImageSet) -> tuple[range, ...]:
    """Ranges of consecutive images of one video where `chosen`, bool [n], is True."""
    found: list[range] = []
    for video in range(len(image_set.videos)):
        images = image_set.images_of(video)
        edges = np.diff(chosen[images.start : images.stop].astype(np.int8), prepend=0, append=0)
        starts, stops = (np.flatnonzero(edges == k) + images.start for k in (1, -1))
        found += map(range, starts.tolist(), stops.tolist())
    return tuple(found)


def thorough_plan(plan: Plan, image_set: ImageSet) -> Plan:
    """Extract all SIFT features, and compare fewer images of different videos.

    Light features gave too few links.
    """
    firsts = [image_set.images_of(video).start for video in range(len(image_set.videos) + 1)]
    between: list[int] = []
    for first, last in pairwise([*firsts, len(image_set.sequence)]):
        own = [image for image in plan.between if first <= image < last]
        between += own[:: max(1, -(-len(own) // _MAX_FULL_IMAGES))]
    return replace(plan, between=between, effort="full")


def searches_all(
    plan: Plan, image_set: ImageSet, matched: MatchedImages, images_apart: float
) -> bool:
    """Whether loop closures are searched in images spread over all videos, not only parts of them.

    In stretches with fast motion, other images are searched than elsewhere.
    """
    in_fast = {image for images in plan.fast for image in images}
    return in_fast.union(plan.loop).issuperset(spread_over_videos(image_set, matched, images_apart))


def spread_over_videos(
    image_set: ImageSet, matched: MatchedImages, images_apart: float
) -> list[int]:
    """`_spread_images` of every video."""
    return [
        image
        for video in range(len(image_set.videos))
        for image in _spread_images(image_set, matched, video, images_apart)
    ]


def _spread_images(
    image_set: ImageSet, matched: MatchedImages, video: int, images_apart: float
) -> list[int]:
    """Select evenly spaced images of a video, at a fraction of the span that tracks reach."""
    images = image_set.images_of(video)
    least = round(_LEAST_STEP / images_apart)
    step = max(1, least, round(_LOOP_SHARE * reach(matched, images)))
    if image_set.num_sequences > 1:
        step = min(step, max(1, len(images) // _LEAST_LOOP_IMAGES))
    return list(images[step // 2 :: step])


def reach(matched: MatchedImages, images: range) -> int:
    """The median span, in images, that the tracks of an image of a video reach."""
    reach = np.ones(len(images), dtype=np.int64)
    for (i, j), geometry in zip(matched.pairs.tolist(), matched.geometries, strict=True):
        if i in images and len(geometry.inlier_matches):
            reach[i - images.start] = max(reach[i - images.start], j - i)
    # The end of the video may cut off the reach of the last third of the images.
    return max(1, int(np.median(reach[: max(1, 2 * len(reach) // 3)])))
