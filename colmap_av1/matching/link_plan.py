"""Which pictures are looked at for links, and which pairs of them are matched."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.takes import Takes
from colmap_av1.matching.features.retrieval import similar_images
from colmap_av1.matching.features.sift import Features
from colmap_av1.matching.image_matches import MatchedImages
from colmap_av1.matching.link_matches import Links
from colmap_av1.matching.link_merging import connected_images
from colmap_av1.matching.weak_gaps import weak_gaps
from colmap_av1.options import LinkOptions, MatchOptions

# Images on either side of a weak gap whose pictures are matched, by their distance from it: the
# nearest see most in common across, those farther off give the scale.
_AROUND_GAP = (0, 1, 2, 4, 7)
# Those whose pictures are held against the motion first: most gaps that seem weak are ordinary.
_FIRST_LOOK = (0, 2)
# Key images for places seen again lie this share of the span that tracks reach apart.
_KEY_SHARE = 0.2
# Places are seen again only in videos that are longer than tracks reach by this factor.
_LONG = 8
_LEAST_IMAGES = 120
# Key images lie at least so many images apart: this bounds what links cost in any video.
_LEAST_STEP = 3
# Key images of each of several videos, where it has as many.
_LEAST_KEY_IMAGES = 12
# Share of inter units from which on motion is what it seems: 85 % is usual, a drive has 50 to 60 %.
_MUCH_MOTION = 0.6
# Gaps that are probed below that.
_NUM_PROBES = 6
# Motion of neighbouring images proves itself, as medians over a video, where it has so many matches
# and this share of them agrees with a rigid scene. A drive has 2,000 and 99.8 %; what an encoder
# takes where a camera is too fast for its search has 20 matches, or 150 and 90 %.
_RIGID_MATCHES = 300
_RIGID_SHARE = 0.98
# Pairs of pictures up to which all are matched: to find those that look alike takes no less time.
_MOST_OF_ALL = 200
# Images of each video, and photos, at most that are searched for all of SIFT's features: this takes
# five times as long.
_MOST_THOROUGH = 12
# Key images on either side of one that is linked to another take which it is matched with, too:
# this gives its features depth.
_BESIDE = 2
# Places of key images of different takes lie farther apart than those that support each other.
_APART = 100


@dataclass(frozen=True)
class Plan:
    """Which pictures are looked at.

    Attributes:
        gaps: int64 [n] weak gaps, by the image before each.
        around: the images whose pictures are matched across each.
        key: images that places seen again are looked for in.
        between: images that are compared with those of other takes.
        effort: of the search for features.
    """

    gaps: NDArray[np.int64]
    around: list[list[int]]
    key: list[int]
    between: list[int]
    effort: Literal["light", "full"] = "light"

    @classmethod
    def of_first_look(cls, weak: NDArray[np.int64], probes: list[int], takes: Takes) -> Plan:
        """A look at few images on either side of gaps: is their motion borne out?"""
        around = {
            gap: _images_around(gap, takes.images_of(int(takes.take[gap])), _FIRST_LOOK)
            for gap in weak.tolist()
        }
        around |= {gap: [gap, gap + 1] for gap in probes if gap not in around}
        gaps = sorted(around)
        return cls(np.array(gaps, np.int64), [around[gap] for gap in gaps], [], [])

    @property
    def wanted(self) -> list[int]:
        """All images whose pictures are needed, ascending."""
        return sorted(
            {image for images in [*self.around, self.key, self.between] for image in images}
        )


def images_to_link(
    inter_share: NDArray[np.float32], frames: NDArray[np.int32], options: LinkOptions
) -> NDArray[np.bool_]:
    """Images of a video whose pictures are matched across gaps that motion may not carry over.

    Args:
        inter_share: see `TrackedVideo`.
        frames: int32 [num_images] frame of each image.
        options: whether there are links.

    Returns:
        bool [num_images]; all where any motion is to be probed.
    """
    chosen = np.zeros(len(frames), dtype=np.bool_)
    weak = weak_gaps(inter_share, frames)
    surely = weak_gaps(inter_share, frames, surely=True)
    if options.links != "none":
        for gap in np.flatnonzero(weak).tolist():
            around = _AROUND_GAP if surely[gap] else _FIRST_LOOK
            chosen[_images_around(gap, range(len(frames)), around)] = True
    if _probes(inter_share, weak, options):
        chosen[:] = True
    return chosen


def plan_links(
    takes: Takes,
    matched: MatchedImages,
    weak: NDArray[np.bool_],
    images_apart: float,
    options: LinkOptions,
) -> Plan:
    """Choose what is looked at: gaps, places seen again in long videos, and several takes.

    Args:
        takes: the images.
        matched: the images, matched along tracks.
        weak: bool [num_images - 1] gaps that motion does not carry over.
        images_apart: images that each of these stands for, see `link_images`.
        options: whether links are wanted, and where.
    """
    if options.links == "none":
        return Plan(np.empty(0, np.int64), [], [], [])
    gaps = np.flatnonzero(weak)
    around = [_images_around(gap, takes.images_of(int(takes.take[gap]))) for gap in gaps.tolist()]
    key = [
        i
        for video in _videos(takes)
        for i in _key_images(takes, matched, video, images_apart, options)
    ]
    between: list[int] = []
    if takes.num_takes > 1:
        between = _spread_over_videos(takes, matched, images_apart)
        between += range(takes.images_of(len(takes.videos)).start, len(takes.take))
    return Plan(gaps, around, key, between)


def plan_anywhere(plan: Plan, takes: Takes, matched: MatchedImages, images_apart: float) -> Plan:
    """The plan with places seen again: what lies on either side of a cut may go on anywhere."""
    return replace(plan, key=_spread_over_videos(takes, matched, images_apart))


def thorough_plan(plan: Plan, takes: Takes) -> Plan:
    """The plan with all of SIFT's features, for what few links connect.

    Args:
        plan: what was tried.
        takes: the images.
    """
    between: list[int] = []
    for first, last in _bounds_of_videos(takes):
        own = [image for image in plan.between if first <= image < last]
        between += own[:: max(1, -(-len(own) // _MOST_THOROUGH))]
    return replace(plan, between=between, effort="full")


def _probes(
    inter_share: NDArray[np.float32], weak: NDArray[np.bool_], options: LinkOptions
) -> list[int]:
    """Gaps whose motion is compared with pictures to tell whether any motion is to be trusted.

    None where most units are inter coded. Where a camera is too fast for its search, an encoder
    takes what compresses well, and that need not be motion.
    """
    if options.links == "none" or len(inter_share) < 2:
        return []
    if float(np.median(inter_share[1:])) >= _MUCH_MOTION:
        return []
    strong = np.flatnonzero(~weak)
    spread = np.linspace(0, len(strong) - 1, min(_NUM_PROBES, len(strong))).round().astype(int)
    return [int(gap) for gap in strong[np.unique(spread)]]


def _images_around(gap: int, images: range, distances: Sequence[int] = _AROUND_GAP) -> list[int]:
    """Images of a video whose pictures are matched across a gap."""
    found = {gap - d for d in distances} | {gap + 1 + d for d in distances}
    return sorted(found & set(images))


def _reach(matched: MatchedImages, images: range) -> int:
    """Span in images that the tracks of half of the images of a video reach."""
    reach = np.ones(len(images), dtype=np.int64)
    for (i, j), geometry in zip(matched.pairs.tolist(), matched.geometries, strict=True):
        if i in images and len(geometry.inlier_matches):
            reach[i - images.start] = max(reach[i - images.start], j - i)
    # The last images have no room for their reach.
    return max(1, int(np.median(reach[: max(1, 2 * len(reach) // 3)])))


def _key_images(
    takes: Takes, matched: MatchedImages, video: int, images_apart: float, options: LinkOptions
) -> list[int]:
    """Images that places seen again are looked for in; none where there can be none."""
    images = takes.images_of(video)
    is_long = len(images) >= max(_LONG * _reach(matched, images), _LEAST_IMAGES / images_apart)
    if options.links == "auto" and not is_long:
        return []
    return _spread_images(takes, matched, video, images_apart)


def _spread_over_videos(takes: Takes, matched: MatchedImages, images_apart: float) -> list[int]:
    """Such images of every video, see `_spread_images`."""
    return [
        image
        for video in _videos(takes)
        for image in _spread_images(takes, matched, video, images_apart)
    ]


def _spread_images(
    takes: Takes, matched: MatchedImages, video: int, images_apart: float
) -> list[int]:
    """Images of a video that lie so far apart that tracks reach over several of them."""
    images = takes.images_of(video)
    least = round(_LEAST_STEP / images_apart)
    step = max(1, least, round(_KEY_SHARE * _reach(matched, images)))
    if takes.num_takes > 1:
        step = min(step, max(1, len(images) // _LEAST_KEY_IMAGES))
    return list(images[step // 2 :: step])


def revisit_pairs(
    takes: Takes,
    matched: MatchedImages,
    key: list[int],
    features: dict[int, Features],
    options: MatchOptions,
) -> set[tuple[int, int]]:
    """Pairs of key images of one video that look alike and that tracks do not connect."""
    pairs: set[tuple[int, int]] = set()
    for video in _videos(takes):
        images = takes.images_of(video)
        present = [image for image in key if image in images and image in features]
        if len(present) < 2:
            continue
        index = np.array(present)
        similar = similar_images(
            [features[i] for i in present],
            np.abs(index[:, None] - index) > _reach(matched, images),
            options.links.link_candidates,
            seed=options.run.seed,
        )
        pairs |= {(present[a], present[b]) for a, b in similar.tolist()}
    return pairs


def _bounds_of_videos(takes: Takes) -> list[tuple[int, int]]:
    """First image of each video and of the photos, and that after their last."""
    firsts = [takes.images_of(video).start for video in range(len(takes.videos) + 1)]
    return list(pairwise([*firsts, len(takes.take)]))


def _videos(takes: Takes) -> range:
    """The takes that are videos."""
    return range(len(takes.videos))


def weak_and_probed_gaps(
    takes: Takes, matched: MatchedImages, inter_share: NDArray[np.float32], options: LinkOptions
) -> tuple[NDArray[np.bool_], NDArray[np.bool_], list[int]]:
    """Gaps between images of a video that hold a weak frame, and those whose motion is probed.

    Between takes there are no gaps: no motion crosses from one to the next.

    Returns:
        bool [num_images - 1] gaps that are surely weak, those that may be ordinary; and indices of
        gaps that stand for all of their video.
    """
    surely = np.zeros(max(len(takes.take) - 1, 0), dtype=np.bool_)
    maybe, probes = np.zeros_like(surely), list[int]()
    for video in _videos(takes):
        share = inter_share[takes.first_frame[video] : takes.first_frame[video + 1]]
        images, frames = takes.images_of(video), takes.of_video(video).frames
        weak, own = weak_gaps(share, frames), slice(images.start, images.stop - 1)
        surely[own] = weak_gaps(share, frames, surely=True)
        maybe[own] = weak & ~surely[own]
        if not _is_rigid(matched, images):
            probes += [images.start + gap for gap in _probes(share, weak, options)]
    return surely, maybe, probes


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


def places_of(images: Iterable[int], takes: Takes) -> dict[int, int]:
    """Places of key images in a row, neighbours of one take beside each other, takes far apart."""
    found: dict[int, int] = {}
    for image in images:
        take = int(takes.take[image])
        found[image] = len(found) + _APART * take
    return found


def pairs_between(
    key: Sequence[int], features: dict[int, Features], takes: Takes, options: MatchOptions
) -> set[tuple[int, int]]:
    """Pairs of key images of different takes: all while they are few, else those that look alike.

    Args:
        key: indices of images, ascending.
        features: features of those that have any picture.
        takes: of which video each image is, or whether it is a photo.
        options: those of links and the seed are used.
    """
    present = np.array([image for image in key if image in features], dtype=np.int64)
    if len(present) < 2:
        return set()
    take = takes.take[present]
    allowed = take[:, None] != take
    pairs = np.argwhere(np.triu(allowed)).tolist()
    if len(pairs) > _MOST_OF_ALL:
        pairs = similar_images(
            [features[i] for i in present.tolist()],
            allowed,
            options.links.link_candidates,
            seed=options.run.seed,
        ).tolist()
    return {(int(present[a]), int(present[b])) for a, b in pairs}


def pairs_beside(links: Links, key: Sequence[int], takes: Takes) -> set[tuple[int, int]]:
    """Pairs of neighbours among the key images of a take, where both are linked to other takes.

    A feature that is linked to one image of another video has no depth there.
    """
    take = takes.take
    between = [pair for pair in links.pairs.tolist() if take[pair[0]] != take[pair[1]]]
    linked = {image for pair in between for image in pair}
    there = [image for image in key if image in linked]
    return {
        (a, b)
        for index, a in enumerate(there)
        for b in there[index + 1 : index + 1 + _BESIDE]
        if take[a] == take[b]
    }


def groups_of_takes(matched: MatchedImages, takes: Takes) -> list[list[int]]:
    """The takes that pairs of images connect, largest group of images first."""
    group = connected_images(matched)
    parts: list[set[int]] = []
    of_group: dict[int, set[int]] = {}
    for image, number in enumerate(group.tolist()):
        of_group.setdefault(number, set()).add(int(takes.take[image]))
    for joined in of_group.values():
        apart = [part for part in parts if not part & joined]
        parts = [*apart, set().union(joined, *(part for part in parts if part & joined))]
    size = np.bincount(takes.take, minlength=takes.num_takes)
    return sorted(map(sorted, parts), key=lambda part: (-int(size[part].sum()), part))
