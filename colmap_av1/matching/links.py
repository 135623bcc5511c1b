"""Links: matches of pictures where motion does not connect images that see the same.

Motion vectors link neighbours in time. Where a camera jerks, a picture is blurred or a place is
seen again, a few pictures get light SIFT features. What these say of a gap decides, too, whether
the motion across it is believed.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from colmap_av1.matching.features import Features
from colmap_av1.matching.image_matches import MatchedImages, nothing_to_match
from colmap_av1.matching.link_matches import (
    Image,
    Pictures,
    broken_gaps,
    extract_features,
    match_pairs,
    supported_links,
)
from colmap_av1.matching.link_merging import (
    connected_images,
    links_as_tracks,
    merge_links,
    no_tracks,
)
from colmap_av1.matching.retrieval import similar_images
from colmap_av1.matching.weak_gaps import weak_gaps
from colmap_av1.options import LinkOptions, MatchOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import VideoSource, decodable_frames
from colmap_av1.util.progress import Clock, Progress
from colmap_av1.video.display import Display

# Images on either side of a weak gap whose pictures are matched, by their distance from it: the
# nearest see most in common across, those farther off give the scale.
_AROUND_GAP = (0, 1, 2, 4, 7)
# Key images for places seen again lie this share of the span that tracks reach apart.
_KEY_SHARE = 0.2
# Places are seen again only in videos that are longer than tracks reach by this factor.
_LONG = 8
_LEAST_IMAGES = 120
# Key images lie at least so many images apart: this bounds what links cost in any video.
_LEAST_STEP = 3
# Inliers across a gap from which on mappers take it: they register an image by 30 points of its,
# of which matches of two images give a part.
_SURE_INLIERS = 100
# Share of inter units from which on motion is what it seems: 85 % is usual, a drive has 50 to 60 %.
_MUCH_MOTION = 0.6
# Gaps that are probed below that, and how many of them, contradicted by pictures, prove it wrong.
_NUM_PROBES = 6
_NUM_BROKEN_PROBES = 2
# Gaps that a warning names.
_NUM_NAMED = 4


@dataclass(frozen=True)
class LinkReport:
    """What linking found.

    Attributes:
        num_images: images whose pictures were looked at.
        num_tried: pairs whose features were matched.
        num_links: pairs that were linked.
        num_revisits: those of them that see a place again.
        weak_gaps: (frame, frame) on either side of gaps that motion does not carry over.
        broken_gaps: those whose motion contradicts the pictures, or is not confirmed by them: its
            matches are left out.
        doubtful_gaps: those that few matches of any kind cross: a mapper may part the images there.
        open_gaps: those across which neither motion nor pictures connect the images.
    """

    num_images: int = 0
    num_tried: int = 0
    num_links: int = 0
    num_revisits: int = 0
    weak_gaps: tuple[tuple[int, int], ...] = ()
    broken_gaps: tuple[tuple[int, int], ...] = ()
    doubtful_gaps: tuple[tuple[int, int], ...] = ()
    open_gaps: tuple[tuple[int, int], ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know: images that nothing connects."""
        if not self.open_gaps:
            return ()
        shown = ", ".join(f"{a} and {b}" for a, b in self.open_gaps[:_NUM_NAMED])
        more = len(self.open_gaps) - _NUM_NAMED
        return (
            f"nothing connects frames {shown}{f' and {more} more pairs' if more > 0 else ''}: the "
            "camera jerks, or the pictures are blurred or cut there, and show nothing in common; "
            "the images on either side become separate models",
        )


@dataclass(frozen=True)
class LinkedImages:
    """Images matched along tracks and by links.

    Attributes:
        matched: the images with all their keypoints and verified matches.
        tracks: the links as tracks, through the frames of the images that have features.
        report: what was found.
    """

    matched: MatchedImages
    tracks: Tracks
    report: LinkReport


def link_video(
    source: VideoSource,
    matched: MatchedImages,
    cameras: Sequence[Any],
    size: tuple[int, int],
    inter_share: NDArray[np.float32],
    *,
    images_apart: float = 1.0,
    display: Display | None,
    options: MatchOptions,
    clock: Clock,
    progress: Progress,
) -> LinkedImages:
    """Link the images of a video by their pictures where motion does not connect them.

    No picture is decoded where motion connects all.

    Args:
        source: the video.
        matched: its images matched along tracks.
        cameras: the camera of each image; images share one where it is the same object.
        size: (width, height) of the images in pixels.
        inter_share: see `TrackedVideo`.
        images_apart: images that each of these stands for, where they are a choice of many.
        display: how pictures are shown in the images; None: as players show them.
        options: those of links, verification and reading are used.
        clock: gets the stage "links".
        progress: called for the stage "links".

    Raises:
        VideoError: neither motion nor pictures connect any two images.
    """
    frames = np.array([k.frame for k in matched.keypoints], dtype=np.int32)
    image_of_frame = {int(frame): image for image, frame in enumerate(frames)}

    def pictures(wanted: list[int]) -> Iterator[tuple[int, Image]]:
        left = set(wanted)
        num_frames = int(frames[wanted[-1]]) + 1
        for frame, picture in decodable_frames(source.pictures, num_frames, options, display):
            image = image_of_frame.get(frame)
            if image in left:
                yield image, picture

    def link(plan: _Plan) -> LinkedImages:
        with clock.measure("links"):
            return _link_images(
                *(plan, matched, cameras, size, pictures),
                num_frames=len(inter_share),
                options=options,
                progress=progress,
            )

    weak = weak_gaps(inter_share, frames)
    probes = _probes(inter_share, weak, options.links)
    if probes and len(link(_Plan.of_neighbours(probes)).report.broken_gaps) >= _NUM_BROKEN_PROBES:
        weak[:] = True
    plan = _plan(matched, weak, images_apart, options.links)
    linked = LinkedImages(matched, no_tracks(len(inter_share), size), LinkReport())
    if plan.wanted:
        linked = link(plan)
    if linked.report.doubtful_gaps:
        # As after a cut: what lies on either side may go on anywhere.
        key = plan.key or _spread_images(matched, images_apart)
        linked = link(replace(plan, key=key, effort="full"))
    if len(linked.matched.pairs) == 0:
        raise nothing_to_match(source.pictures.path, options)
    return linked


def _link_images(
    plan: _Plan,
    matched: MatchedImages,
    cameras: Sequence[Any],
    size: tuple[int, int],
    pictures: Pictures,
    *,
    num_frames: int,
    options: MatchOptions,
    progress: Progress,
) -> LinkedImages:
    """Link the images of a plan, see `link_video`."""
    frames = np.array([k.frame for k in matched.keypoints], dtype=np.int32)
    gaps, key = plan.gaps, plan.key
    features = extract_features(
        plan.wanted, pictures, size, options.links, effort=plan.effort, progress=progress
    )
    gap_pairs = {(i, j) for images in plan.around for i in images for j in images if i < j}
    revisit_pairs = _revisit_pairs(matched, key, features, options) - gap_pairs
    tried = np.array(sorted(gap_pairs | revisit_pairs), dtype=np.int32).reshape(-1, 2)
    links = match_pairs(
        tried,
        features,
        cameras=cameras,
        verify=options.verify,
        run=options.run,
        progress=progress,
    )
    links, num_revisits = supported_links(links, revisit_pairs, key)
    broken = broken_gaps(gaps, links, matched, cameras)
    merged = merge_links(matched, links, features, broken)
    group = connected_images(merged)
    unlinked = [gap for gap in gaps.tolist() if group[gap] != group[gap + 1]]

    def between(which: Sequence[int]) -> tuple[tuple[int, int], ...]:
        return tuple((int(frames[g]), int(frames[g + 1])) for g in which)

    report = LinkReport(
        num_images=len(plan.wanted),
        num_tried=len(tried),
        num_links=len(links.pairs),
        num_revisits=num_revisits,
        weak_gaps=between(gaps.tolist()),
        broken_gaps=between(broken),
        doubtful_gaps=between([gap for gap in gaps.tolist() if _is_doubtful(gap, merged)]),
        open_gaps=between(unlinked),
    )
    tracks = links_as_tracks(links, features, frames, num_frames, size)
    return LinkedImages(merged, tracks, report)


@dataclass(frozen=True)
class _Plan:
    """Which pictures are looked at.

    Attributes:
        gaps: int64 [n] weak gaps, by the image before each.
        around: the images whose pictures are matched across each.
        key: images that places seen again are looked for in.
        effort: of the search for features.
    """

    gaps: NDArray[np.int64]
    around: list[list[int]]
    key: list[int]
    effort: Literal["light", "full"] = "light"

    @classmethod
    def of_neighbours(cls, gaps: list[int]) -> _Plan:
        """A look at the images on either side of some gaps, no more."""
        return cls(np.array(gaps, np.int64), [[gap, gap + 1] for gap in gaps], [])

    @property
    def wanted(self) -> list[int]:
        """All images whose pictures are needed, ascending."""
        return sorted({image for images in [*self.around, self.key] for image in images})


def images_to_link(
    inter_share: NDArray[np.float32], frames: NDArray[np.int32], options: LinkOptions
) -> NDArray[np.bool_]:
    """Images whose pictures are matched across gaps that motion may not carry over.

    Args:
        inter_share: see `TrackedVideo`.
        frames: int32 [num_images] frame of each image.
        options: whether there are links.

    Returns:
        bool [num_images]; all where any motion is to be probed.
    """
    chosen = np.zeros(len(frames), dtype=np.bool_)
    weak = weak_gaps(inter_share, frames)
    if options.links != "none":
        for gap in np.flatnonzero(weak).tolist():
            chosen[_images_around(gap, len(frames))] = True
    if _probes(inter_share, weak, options):
        chosen[:] = True
    return chosen


def _plan(
    matched: MatchedImages, weak: NDArray[np.bool_], images_apart: float, options: LinkOptions
) -> _Plan:
    gaps = np.flatnonzero(weak) if options.links != "none" else np.empty(0, np.int64)
    around = [_images_around(int(gap), len(matched.keypoints)) for gap in gaps]
    return _Plan(gaps, around, _key_images(matched, images_apart, options))


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


def _is_doubtful(gap: int, matched: MatchedImages) -> bool:
    """Whether no pair of images across a gap has the inliers that a mapper is sure of."""
    crossing = (matched.pairs[:, 0] <= gap) & (matched.pairs[:, 1] > gap)
    inliers = [len(matched.geometries[k].inlier_matches) for k in np.flatnonzero(crossing)]
    return max(inliers, default=0) < _SURE_INLIERS


def _images_around(gap: int, num_images: int) -> list[int]:
    """Images whose pictures are matched across a gap."""
    found = {gap - d for d in _AROUND_GAP} | {gap + 1 + d for d in _AROUND_GAP}
    return sorted(i for i in found if 0 <= i < num_images)


def _reach(matched: MatchedImages) -> int:
    """Span in images that the tracks of half of the images reach."""
    reach = np.ones(len(matched.keypoints), dtype=np.int64)
    for (i, j), geometry in zip(matched.pairs.tolist(), matched.geometries, strict=True):
        if len(geometry.inlier_matches):
            reach[i] = max(reach[i], j - i)
    # The last images have no room for their reach.
    return max(1, int(np.median(reach[: max(1, 2 * len(reach) // 3)])))


def _key_images(matched: MatchedImages, images_apart: float, options: LinkOptions) -> list[int]:
    """Images that places seen again are looked for in; none where there can be none."""
    num_images, reach = len(matched.keypoints), _reach(matched)
    is_long = num_images >= max(_LONG * reach, _LEAST_IMAGES / images_apart)
    if options.links == "none" or (options.links == "auto" and not is_long):
        return []
    return _spread_images(matched, images_apart)


def _spread_images(matched: MatchedImages, images_apart: float) -> list[int]:
    """Images that lie so far apart that tracks reach over several of them."""
    num_images = len(matched.keypoints)
    step = max(1, round(_LEAST_STEP / images_apart), round(_KEY_SHARE * _reach(matched)))
    return list(range(step // 2, num_images, step))


def _revisit_pairs(
    matched: MatchedImages,
    key: list[int],
    features: dict[int, Features],
    options: MatchOptions,
) -> set[tuple[int, int]]:
    """Pairs of key images that look alike and that tracks do not connect."""
    present = [image for image in key if image in features]
    if len(present) < 2:
        return set()
    index = np.array(present)
    allowed = np.abs(index[:, None] - index) > _reach(matched)
    similar = similar_images(
        [features[i] for i in present],
        allowed,
        options.links.link_candidates,
        seed=options.run.seed,
    )
    return {(present[a], present[b]) for a, b in similar.tolist()}
