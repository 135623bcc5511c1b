"""SIFT links: matches of SIFT features between images that motion does not connect.

Motion vectors connect images that are neighbours in time. At gaps (the camera jerks, a picture is
blurred) and at loop closures, SIFT features are extracted from a few pictures. The features across
a gap also decide whether the motion across it is kept.

The steps: plan which pictures are examined and which pairs are tried; match their features; compare
them with the motion across gaps; merge them with the matches of tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.geometry.masks import Mask
from colmap_av1.images.image_set import ImageSet, Pictures
from colmap_av1.matching.features.overlays import without_overlays
from colmap_av1.matching.features.retrieval import similar_images
from colmap_av1.matching.features.sift import (
    Features,
    extract_features,
    masked_features,
    match_features,
)
from colmap_av1.matching.gaps import (
    Gap,
    GapReason,
    SuspectGaps,
    low_inter_gaps,
    probed_gaps,
    suspect_gaps,
)
from colmap_av1.matching.image_matches import MatchedImages, connected_images, nothing_to_match
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewConfig, TwoViewGeometry
from colmap_av1.matching.verify import agreeing_matches, verify_pairs
from colmap_av1.options import LinkOptions, PairOptions, VerifyOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.graphs import connected_components
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.spread import evenly_spread
from colmap_av1.util.texts import some_names

# --- Which pictures are examined.
# Images to examine on either side of a gap, by their distance from it. The nearest have the most in
# common, the others determine the scale.
_AROUND_GAP = (0, 1, 2, 4, 7)
# While the camera moves fast, too few tracks last to determine the scale. All pictures are then
# matched with their neighbours, as in COLMAP's sequential matcher, and every n-th image is searched
# for loop closures. If features link two neighbours with this many inliers, the motion across them
# is dropped.
_FAST_INLIERS = 50
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
# Up to this number of pairs, all are matched, because retrieval would not be faster.
_MAX_EXHAUSTIVE_PAIRS = 200
# Number of images of each video, and of photos, in which all SIFT features are extracted. That
# takes five times as long as light features.
_MAX_FULL_IMAGES = 12
# An image that is linked to another video is also matched with this many neighbours, which gives
# its features depth.
_NEIGHBOURS = 2
# Distance between videos in the order that `_supported` uses; larger than `_SUPPORT_REACH`.
_VIDEO_OFFSET = 100
# A video without any motion has no detail if its images have fewer features than this; others have
# hundreds. The second value is the number of images examined.
_FEW_FEATURES = 20
_NUM_SAMPLES = 3

# --- Which links and which motion are kept.
# Fewest inliers across a gap. A loop closure needs more, because nothing else confirms it.
_MIN_GAP_INLIERS = 20
_MIN_LOOP_INLIERS = 25
# A loop closure is confirmed by another one between neighbours up to this distance.
_SUPPORT_REACH = 2
# Two videos are the same if this number and this share of the examined pictures have their features
# at the same positions, to within this many pixels. Videos of two cameras have one or two such
# pictures at most.
_FEWEST_SAME = 3
_SAME_SHARE = 0.3
_SAME_PLACE = 1.0
# The motion across a gap is kept if this share of its matches agrees with the two-view geometry of
# the pictures to within this many pixels: 98 to 100 % of true motion does, but at most three
# quarters of vectors that merely compress well.
_MIN_AGREEING = 0.85
_MAX_ERROR = 3.0
# Mappers need 30 points to register an image, and only a part of the matches of two images become
# points. With this number of inliers across a gap they always succeed.
_SURE_INLIERS = 100
# Motion that the pictures confirm is kept with this share of the usual inliers of neighbours.
_ENOUGH_OF_USUAL = 0.3
# If the pictures contradict this many probed gaps of a video, all its motion is wrong.
_NUM_WRONG_PROBES = 2

# --- Merging.
# A feature this close to a track's keypoint, in pixels, is the same keypoint.
_JOIN_DISTANCE = 1.0
# Expected error of a feature in pixels.
_SIGMA = 0.5

# Number of gaps that a warning names.
_NUM_NAMED = 4


@dataclass(frozen=True)
class LinkReport:
    """Result of linking. Frames are counted through all videos.

    Attributes:
        num_images: images whose pictures were examined.
        looked_again: whether loop closures were searched.
        num_tried: pairs whose features were matched.
        num_links: pairs that were linked.
        num_revisits: linked pairs that close a loop.
        num_between: linked pairs of different videos or photos.
        gaps: gaps that motion does not bridge, in order.
        fast: first and last frame of each stretch in which the camera moves fast and all pictures
            were matched with their neighbours.
        videos: (name, first frame) of each video if there are several.
        parts: the names of the videos in each connected group, if there are several groups.
        unlinked_photos: names of photos that nothing connects to a video.
        same_videos: (name, name) of videos that show the same pictures.
    """

    num_images: int = 0
    looked_again: bool = False
    num_tried: int = 0
    num_links: int = 0
    num_revisits: int = 0
    num_between: int = 0
    gaps: tuple[Gap, ...] = ()
    fast: tuple[tuple[int, int], ...] = ()
    videos: tuple[tuple[str, int], ...] = ()
    parts: tuple[tuple[str, ...], ...] = ()
    unlinked_photos: tuple[str, ...] = ()
    same_videos: tuple[tuple[str, str], ...] = ()

    def frames_of_gaps(self, reason: GapReason = "low inter share") -> list[tuple[int, int]]:
        """Frames on either side of each gap with a reason; every gap has the default reason."""
        return [gap.frames for gap in self.gaps if gap.frames and reason in gap.reasons]

    @property
    def warnings(self) -> tuple[str, ...]:
        """Warnings about unconnected images and about videos that are the same."""
        same = (
            f"'{first}' and '{second}' show the same pictures, like two encodings of one video: "
            "give only one of them, the other takes time and adds nothing"
            for first, second in self.same_videos
        )
        return (*self._gap_warnings(), *self._part_warnings(), *self._photo_warnings(), *same)

    def _gap_warnings(self) -> tuple[str, ...]:
        gaps = self.frames_of_gaps("no overlap")
        if not gaps:
            return ()
        shown = []
        for gap in gaps[:_NUM_NAMED]:
            name, before, after = gap_in_video(gap, self.videos)
            shown.append(f"{before} and {after} of '{name}'" if name else f"{before} and {after}")
        more = f" and {len(gaps) - _NUM_NAMED} more pairs" if len(gaps) > _NUM_NAMED else ""
        return (
            f"nothing connects frames {', '.join(shown)}{more}: the camera jerks, or a picture is "
            "blurred, or there is a cut, and the pictures have nothing in common; the images on "
            "either side become separate models",
        )

    def _part_warnings(self) -> tuple[str, ...]:
        if not self.parts:
            return ()
        if self.num_images == 0:
            names = ", ".join(f"'{name}'" for part in self.parts for name in part)
            return (f"{names} are not connected with --links none: they become separate models",)
        groups = " from ".join(", ".join(f"'{name}'" for name in part) for part in self.parts)
        return (
            f"nothing in the pictures connects {groups}: they become {len(self.parts)} separate "
            "models; film what both have in view, or match videos of different scenes separately",
        )

    def _photo_warnings(self) -> tuple[str, ...]:
        if not self.unlinked_photos:
            return ()
        names = some_names(self.unlinked_photos)
        return (
            f"{len(self.unlinked_photos)} photos have nothing in common with any video and are "
            f"not connected: {names}",
        )


def gap_in_video(gap: Sequence[int], videos: Sequence[tuple[str, int]]) -> tuple[str, int, int]:
    """Name of a gap's video ('' for a single video), and the gap's frames counted in that video."""
    name, first = next((v for v in reversed(videos) if v[1] <= gap[0]), ("", 0))
    return name, gap[0] - first, gap[1] - first


@dataclass(frozen=True)
class LinkedImages:
    """Images matched along tracks and by links.

    Attributes:
        matched: the images with all keypoints and verified matches.
        tracks: the links as tracks through the frames of the images that have features.
        report: report on the links.
    """

    matched: MatchedImages
    tracks: Tracks
    report: LinkReport


def link_images(
    image_set: ImageSet,
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    inter_share: NDArray[np.float32],
    pictures: Pictures,
    *,
    fast: NDArray[np.bool_],
    pairs: PairOptions,
    verify: VerifyOptions,
    links: LinkOptions,
    context: RunContext,
    name: str,
    images_apart: float = 1.0,
) -> LinkedImages:
    """Link images by SIFT features where motion does not connect them.

    If motion connects all images, which is possible for a single video only, no picture is decoded.

    Args:
        image_set: the images of videos and photos.
        matched: the images, matched along tracks.
        cameras: the camera of each image; images that share a camera hold the same object.
        inter_share: float32 [num_frames], see `TrackedVideo`; any numbers for photos.
        pictures: returns the pictures of images.
        fast: bool [num_images] images around which the camera moves fast, see `fast_frames`.
        pairs: offsets of neighbours in fast stretches, and fewest matches for messages.
        verify: how links are verified.
        links: whether and where images are linked.
        context: its clock gets the stage "links", its progress "links" and "link matches".
        name: name of the videos in messages.
        images_apart: if the images are a selection, the number of images that each represents.

    Raises:
        VideoError: neither motion nor pictures connect any two images.
    """
    found: dict[str, dict[int, Features]] = {"light": {}, "full": {}}

    def features_of(wanted: Iterable[int], effort: Literal["light", "full"]) -> dict[int, Features]:
        known = found[effort]
        missing = sorted(set(wanted) - known.keys())
        with context.clock.measure("links"):
            known |= features_of_images(
                missing, pictures, cameras, image_set.masks, links, effort=effort, context=context
            )
        return {image: known[image] for image in wanted if image in known}

    def link(plan: Plan) -> LinkedImages:
        features = features_of(plan.wanted, plan.effort)
        with context.clock.measure("links"):
            features = without_overlays(features, cameras)
            return _link(
                plan,
                image_set,
                matched,
                cameras,
                features,
                offsets=pairs.offsets,
                verify=verify,
                options=links,
                context=context,
            )

    suspect = suspect_gaps(image_set, matched, inter_share, links)
    gaps = suspect.certain
    plan = plan_links(image_set, matched, gaps, images_apart, links, fast=fast)
    if links.links != "none" and (suspect.maybe.any() or suspect.probes):
        first = _first_look(suspect, image_set)
        also = plan.wanted if plan.effort == "light" else []
        features_of([*first.wanted, *also], "light")  # decodes the videos only once
        gaps = gaps | _confirmed_gaps(link(first).report, suspect, matched, image_set)
        plan = plan_links(image_set, matched, gaps, images_apart, links, fast=fast)
    if plan.wanted:
        linked = link(plan)
    else:
        nothing = Tracks.empty(image_set.num_frames, _largest_size(cameras))
        linked = LinkedImages(matched, nothing, _with_parts(LinkReport(), matched, image_set))
    if linked.report.frames_of_gaps("no overlap" if plan.loop else "few tracks"):
        # The scene on either side of a cut may reappear anywhere in the videos.
        loop = sorted({*plan.loop, *_spread_over_videos(image_set, matched, images_apart)})
        if loop != plan.loop:
            plan = replace(plan, loop=loop)
            linked = link(plan)
    few = linked.report.frames_of_gaps("few tracks")
    if plan.effort == "light" and plan.wanted and (few or linked.report.parts):
        linked = link(thorough_plan(plan, image_set))
    if len(linked.matched.pairs) == 0:
        if links.links != "none" and not found["light"]:
            features_of(evenly_spread(len(image_set.sequence), _NUM_SAMPLES, rounded=True), "light")
        sizes = [len(features.xy) for features in found["light"].values()]
        if sizes and np.median(sizes) < _FEW_FEATURES:
            raise VideoError(
                f"{name}: the pictures have hardly any detail to match ({np.median(sizes):.0f} "
                "features each): film a scene with texture, well lit and in focus"
            )
        raise nothing_to_match(name, pairs)
    examined = found["light"].keys() | found["full"].keys()
    return replace(linked, report=replace(linked.report, num_images=len(examined)))


# --- Planning: which pictures are examined.


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

    gaps: NDArray[np.int64]
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
) -> NDArray[np.bool_]:
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


def _first_look(suspect: SuspectGaps, image_set: ImageSet) -> Plan:
    """Plan to examine a few images on either side of each suspect gap."""
    around = {
        gap: _images_around(gap, image_set.images_of(int(image_set.sequence[gap])), _FIRST_LOOK)
        for gap in np.flatnonzero(suspect.maybe).tolist()
    }
    around |= {gap: [gap, gap + 1] for gap in suspect.probes if gap not in around}
    gaps = sorted(around)
    return Plan(np.array(gaps, np.int64), [around[gap] for gap in gaps], [], [])


def _confirmed_gaps(
    report: LinkReport, suspect: SuspectGaps, matched: MatchedImages, image_set: ImageSet
) -> NDArray[np.bool_]:
    """Find suspect gaps whose motion the first look contradicts, or that few tracks cross.

    If several probes of a video are contradicted, all its gaps are included.

    Args:
        report: report of the first look.
        suspect: the gaps that were examined.
        matched: the images, matched along tracks.
        image_set: the images.

    Returns:
        bool [num_images - 1].
    """
    wrong = sorted({frame for frame, _ in report.frames_of_gaps("contradicted")})
    is_wrong = np.isin(image_set.images.frames[:-1], wrong)
    across = np.zeros(len(suspect.maybe))
    for (i, j), geometry in zip(matched.pairs.tolist(), matched.geometries, strict=True):
        if j == i + 1:
            across[i] = len(geometry.inlier_matches)
    enough = max(_SURE_INLIERS, _ENOUGH_OF_USUAL * float(np.median(across)))
    confirmed = suspect.maybe & (is_wrong | (across < enough))
    wrong_probes = [int(image_set.sequence[gap]) for gap in suspect.probes if is_wrong[gap]]
    for sequence, count in enumerate(
        np.bincount(wrong_probes, minlength=image_set.num_sequences).tolist()
    ):
        if count >= _NUM_WRONG_PROBES:
            images = image_set.images_of(sequence)
            confirmed[images.start : images.stop - 1] = True
    return confirmed


def plan_links(
    image_set: ImageSet,
    matched: MatchedImages,
    gaps: NDArray[np.bool_],
    images_apart: float,
    options: LinkOptions,
    *,
    fast: NDArray[np.bool_],
) -> Plan:
    """Choose the pictures to examine at gaps, for loop closures in long videos, and between videos.

    Args:
        image_set: the images.
        matched: the images, matched along tracks.
        gaps: bool [num_images - 1] gaps that motion does not bridge.
        images_apart: see `link_images`.
        options: whether and where images are linked.
        fast: bool [num_images] images around which the camera moves fast, see `fast_frames`.
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
        least = max(_LONG * _reach(matched, images), _LEAST_IMAGES / images_apart)
        if options.links != "auto" or len(images) >= least:
            loop += _spread_images(image_set, matched, video, images_apart)
    if stretches:
        loop = sorted({*loop, *(i for own in stretches for i in own[::_LOOP_STEP])})
    between: list[int] = []
    if image_set.num_sequences > 1:
        between = _spread_over_videos(image_set, matched, images_apart)
        between += range(image_set.images_of(len(image_set.videos)).start, len(image_set.sequence))
    return Plan(
        chosen,
        around,
        loop,
        between,
        stretches,
        effort="full" if stretches else "light",
    )


def _stretches(chosen: NDArray[np.bool_], image_set: ImageSet) -> tuple[range, ...]:
    """Ranges of consecutive images of one video where `chosen`, bool [num_images], is True."""
    found: list[range] = []
    for video in range(len(image_set.videos)):
        images = image_set.images_of(video)
        edges = np.diff(chosen[images.start : images.stop].astype(np.int8), prepend=0, append=0)
        starts, stops = (np.flatnonzero(edges == k) + images.start for k in (1, -1))
        found += map(range, starts.tolist(), stops.tolist())
    return tuple(found)


def thorough_plan(plan: Plan, image_set: ImageSet) -> Plan:
    """Extract all SIFT features, in fewer images, because light features gave too few links."""
    firsts = [image_set.images_of(video).start for video in range(len(image_set.videos) + 1)]
    between: list[int] = []
    for first, last in pairwise([*firsts, len(image_set.sequence)]):
        own = [image for image in plan.between if first <= image < last]
        between += own[:: max(1, -(-len(own) // _MAX_FULL_IMAGES))]
    return replace(plan, between=between, effort="full")


def _spread_over_videos(
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
    step = max(1, least, round(_LOOP_SHARE * _reach(matched, images)))
    if image_set.num_sequences > 1:
        step = min(step, max(1, len(images) // _LEAST_LOOP_IMAGES))
    return list(images[step // 2 :: step])


def _reach(matched: MatchedImages, images: range) -> int:
    """The median span, in images, that the tracks of an image of a video reach."""
    reach = np.ones(len(images), dtype=np.int64)
    for (i, j), geometry in zip(matched.pairs.tolist(), matched.geometries, strict=True):
        if i in images and len(geometry.inlier_matches):
            reach[i - images.start] = max(reach[i - images.start], j - i)
    # The end of the video may cut off the reach of the last third of the images.
    return max(1, int(np.median(reach[: max(1, 2 * len(reach) // 3)])))


# --- Matching the features of the planned pictures.


@dataclass(frozen=True)
class Links:
    """Verified matches of features.

    Attributes:
        pairs: int32 [m, 2] indices of images, first < second, ascending.
        geometries: the two-view geometry of each pair; its inliers are indices of features.
    """

    pairs: NDArray[np.int32]
    geometries: list[TwoViewGeometry]

    def joined(self, other: Links) -> Links:
        """These links together with those of other pairs."""
        pairs = np.concatenate([self.pairs, other.pairs])
        geometries = [*self.geometries, *other.geometries]
        order = np.lexsort((pairs[:, 1], pairs[:, 0])).tolist()
        return Links(pairs[order], [geometries[k] for k in order])


def _link(
    plan: Plan,
    image_set: ImageSet,
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
    features: dict[int, Features],
    *,
    offsets: Sequence[int],
    verify: VerifyOptions,
    options: LinkOptions,
    context: RunContext,
) -> LinkedImages:
    """Link the images of a plan by their features, see `link_images`.

    In fast stretches, each image is matched with the images at the distances `offsets`.
    """

    def matched_pairs(pairs: set[tuple[int, int]]) -> Links:
        ordered = np.array(sorted(pairs), dtype=np.int32).reshape(-1, 2)
        return match_pairs(ordered, features, cameras, verify, context)

    across = {(i, j) for images in plan.around for i in images for j in images if i < j}
    across |= {
        (i, i + offset)
        for images in plan.fast
        for offset in offsets
        for i in images[: -min(offset, len(images))]
    }
    loops = (
        _loop_pairs(image_set, matched, plan.loop, features, options, seed=context.seed) - across
    )
    between = _pairs_between(plan.between, features, image_set, options, seed=context.seed)
    tried = across | loops | between
    links = _supported(
        matched_pairs(tried), loops | between, sorted({*plan.loop, *plan.between}), image_set
    )
    found = {tuple(pair) for pair in links.pairs.tolist()}
    neighbours = _neighbour_pairs(links, plan.between, image_set) - tried
    if neighbours:
        links = links.joined(matched_pairs(neighbours))
    contradicted = contradicted_gaps(plan.gaps, links, matched, cameras)
    in_fast = {image for images in plan.fast for image in images[:-1]}
    linked = [
        i
        for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True)
        if j == i + 1 and i in in_fast and len(geometry.inlier_matches) >= _FAST_INLIERS
    ]
    merged = merge_links(matched, links, features, [*contradicted, *linked])
    report = LinkReport(
        num_images=len(plan.wanted),
        looked_again=bool(plan.loop),
        num_tried=len(tried | neighbours),
        num_links=len(links.pairs),
        num_revisits=len(loops & found),
        num_between=len(between & found),
        gaps=_gaps_after_linking(plan.gaps, contradicted, merged, image_set),
        fast=tuple(
            (int(image_set.images.frames[own[0]]), int(image_set.images.frames[own[-1]]))
            for own in plan.fast
        ),
        same_videos=_same_videos(links, features, cameras, image_set),
    )
    tracks = links_as_tracks(
        links, features, image_set.images.frames, image_set.num_frames, _largest_size(cameras)
    )
    return LinkedImages(merged, tracks, _with_parts(report, merged, image_set))


def features_of_images(
    wanted: list[int],
    pictures: Pictures,
    cameras: Sequence[pycolmap.Camera],
    masks: Sequence[Mask | None],
    options: LinkOptions,
    *,
    effort: Literal["light", "full"],
    context: RunContext,
) -> dict[int, Features]:
    """Extract features outside masked pixels; positions are in pixels of the images."""
    found: dict[int, Features] = {}
    for image, picture in pictures(wanted):
        features = extract_features(picture, options.max_link_features, effort)
        features = masked_features(features, picture, masks[image])
        width, height = int(cameras[image].width), int(cameras[image].height)
        scale = np.array([width / picture.shape[1], height / picture.shape[0]], np.float32)
        found[image] = replace(features, xy=features.xy * scale)
        context.progress("links", len(found), len(wanted))
    return found


def _loop_pairs(
    image_set: ImageSet,
    matched: MatchedImages,
    loop: list[int],
    features: dict[int, Features],
    options: LinkOptions,
    *,
    seed: int,
) -> set[tuple[int, int]]:
    """Find similar images of one video that tracks do not connect."""
    pairs: set[tuple[int, int]] = set()
    for video in range(len(image_set.videos)):
        images = image_set.images_of(video)
        present = [image for image in loop if image in images and image in features]
        if len(present) < 2:
            continue
        index = np.array(present)
        similar = similar_images(
            [features[i] for i in present],
            np.abs(index[:, None] - index) > _reach(matched, images),
            options.link_candidates,
            seed=seed,
        )
        pairs |= {(present[a], present[b]) for a, b in similar.tolist()}
    return pairs


def _pairs_between(
    images: Sequence[int],
    features: dict[int, Features],
    image_set: ImageSet,
    options: LinkOptions,
    *,
    seed: int,
) -> set[tuple[int, int]]:
    """Pair images of different videos or photos: all if there are few pairs, else similar ones."""
    present = np.array([image for image in images if image in features], dtype=np.int64)
    if len(present) < 2:
        return set()
    sequence = image_set.sequence[present]
    allowed = sequence[:, None] != sequence
    pairs = np.argwhere(np.triu(allowed)).tolist()
    if len(pairs) > _MAX_EXHAUSTIVE_PAIRS:
        pairs = similar_images(
            [features[i] for i in present.tolist()], allowed, options.link_candidates, seed=seed
        ).tolist()
    return {(int(present[a]), int(present[b])) for a, b in pairs}


def _neighbour_pairs(
    links: Links, images: Sequence[int], image_set: ImageSet
) -> set[tuple[int, int]]:
    """Pair neighbouring images of a video that are both linked to other videos.

    These pairs give depth to features that are linked to a single image of another video.
    """
    sequence = image_set.sequence
    between = [pair for pair in links.pairs.tolist() if sequence[pair[0]] != sequence[pair[1]]]
    linked = {image for pair in between for image in pair}
    there = [image for image in images if image in linked]
    return {
        (a, b)
        for index, a in enumerate(there)
        for b in there[index + 1 : index + 1 + _NEIGHBOURS]
        if sequence[a] == sequence[b]
    }


def match_pairs(
    pairs: NDArray[np.int32],
    features: dict[int, Features],
    cameras: Sequence[pycolmap.Camera],
    verify: VerifyOptions,
    context: RunContext,
) -> Links:
    """Match the features of image pairs and verify the matches.

    Pairs with an image that has no entry in `features` are left out.
    """
    nothing = np.empty((0, 2), np.float32)
    xy = [features[i].xy if i in features else nothing for i in range(len(cameras))]
    # Verification uses neither frames nor tracks.
    views = [ImageKeypoints(0, own, np.arange(len(own), dtype=np.int64)) for own in xy]
    there = [i in features and j in features for i, j in pairs.tolist()]
    pairs = pairs[np.array(there, dtype=np.bool_)]
    matches = []
    with one_blas_thread():
        for i, j in pairs.tolist():
            matches.append(match_features(features[i], features[j]))
            context.progress("link matches", len(matches), len(pairs))
    options = replace(verify, min_num_inliers=max(verify.min_num_inliers, _MIN_GAP_INLIERS))
    geometries = verify_pairs(
        views,
        pairs,
        matches,
        cameras,
        options,
        num_threads=context.num_threads,
        seed=context.seed,
    )
    kept = [k for k, g in enumerate(geometries) if len(g.inlier_matches) > 0]
    return Links(pairs[kept], [geometries[k] for k in kept])


def _supported(
    links: Links, loops: set[tuple[int, int]], images: Sequence[int], image_set: ImageSet
) -> Links:
    """Drop loop closures that no neighbouring loop closure confirms.

    Args:
        links: the links.
        loops: pairs of images that close a loop or connect videos.
        images: the images of these pairs, ascending; images close together in the list have nearly
            the same view.
        image_set: the images. Photos have no neighbours: their links are confirmed by a third
            image that is linked to both.
    """
    place = {
        image: k + _VIDEO_OFFSET * int(image_set.sequence[image]) for k, image in enumerate(images)
    }
    photos = set(range(image_set.images_of(len(image_set.videos)).start, len(image_set.sequence)))
    pairs = [(i, j) for i, j in links.pairs.tolist()]
    sure = {
        (i, j)
        for (i, j), g in zip(pairs, links.geometries, strict=True)
        if (i, j) in loops and len(g.inlier_matches) >= _MIN_LOOP_INLIERS
    }
    places = {(place[i], place[j]) for i, j in sure}
    around = range(-_SUPPORT_REACH, _SUPPORT_REACH + 1)
    linked: dict[int, set[int]] = {}
    for i, j in sure:
        linked.setdefault(i, set()).add(j)
        linked.setdefault(j, set()).add(i)

    def is_supported(i: int, j: int) -> bool:
        a, b = place[i], place[j]
        near = ((a + da, b + db) in places for da in around for db in around if da or db)
        return any(near) or bool({i, j} & photos and linked[i] & linked[j])

    supported = {pair for pair in sure if is_supported(*pair)}
    kept = [k for k, pair in enumerate(pairs) if pair not in loops or pair in supported]
    return Links(links.pairs[kept], [links.geometries[k] for k in kept])


# --- Evidence of the links about gaps and videos.


def contradicted_gaps(
    gaps: NDArray[np.int64],
    links: Links,
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
) -> list[int]:
    """Find the gaps whose motion the pictures contradict or do not confirm."""
    of_pair = {pair: k for k, pair in enumerate(map(tuple, matched.pairs.tolist()))}
    contradicted = []
    for gap in gaps.tolist():
        num_matches = num_agreeing = 0
        crossing = np.flatnonzero((links.pairs[:, 0] <= gap) & (links.pairs[:, 1] > gap))
        for k in crossing.tolist():
            i, j = links.pairs[k].tolist()
            if (i, j) not in of_pair:
                continue
            matches = matched.matches[of_pair[i, j]]
            num_matches += len(matches)
            agrees = agreeing_matches(
                links.geometries[k],
                matched.keypoints[i].xy[matches[:, 0]],
                matched.keypoints[j].xy[matches[:, 1]],
                (cameras[i], cameras[j]),
                max_error=_MAX_ERROR,
            )
            num_agreeing += int(np.count_nonzero(agrees))
        if num_agreeing < _MIN_AGREEING * num_matches or num_matches == 0:
            contradicted.append(gap)
    return contradicted


def _gaps_after_linking(
    gaps: NDArray[np.int64], contradicted: Sequence[int], merged: MatchedImages, image_set: ImageSet
) -> tuple[Gap, ...]:
    """List the gaps of a plan with their reasons."""
    group = connected_images(merged)
    sequence = image_set.sequence[merged.pairs]
    found = []
    for gap in gaps.tolist():
        reasons: list[GapReason] = ["low inter share"]
        crossing = (merged.pairs[:, 0] <= gap) & (merged.pairs[:, 1] > gap)
        crossing &= sequence[:, 0] == sequence[:, 1]
        inliers = [len(merged.geometries[k].inlier_matches) for k in np.flatnonzero(crossing)]
        if max(inliers, default=0) < _SURE_INLIERS:
            reasons.append("few tracks")
        if gap in contradicted:
            reasons.append("contradicted")
        if group[gap] != group[gap + 1]:
            reasons.append("no overlap")
        names, frames = image_set.images.names, image_set.images.frames
        between = int(frames[gap]), int(frames[gap + 1])
        found.append(Gap(names[gap], names[gap + 1], tuple(reasons), between))
    return tuple(found)


def _same_videos(
    links: Links,
    features: dict[int, Features],
    cameras: Sequence[pycolmap.Camera],
    image_set: ImageSet,
) -> tuple[tuple[str, str], ...]:
    """Find pairs of videos that show the same pictures, like two encodings of one video."""
    alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True):
        pair = int(image_set.sequence[i]), int(image_set.sequence[j])
        if pair[0] == pair[1] or max(pair) >= len(image_set.videos):
            continue
        a, b = geometry.inlier_matches.T
        scale = cameras[i].width / cameras[j].width
        apart = np.hypot(*(features[i].xy[a] - features[j].xy[b] * scale).T)
        if np.median(apart) <= _SAME_PLACE:
            alike.setdefault(pair, []).append((i, j))
    num_examined = np.bincount(
        image_set.sequence[sorted(features)], minlength=image_set.num_sequences
    )
    found = []
    for pair, images in sorted(alike.items()):
        num_same = [len(set(own)) for own in zip(*images, strict=True)]
        share = max(
            same / num_examined[sequence] for same, sequence in zip(num_same, pair, strict=True)
        )
        if min(num_same) >= _FEWEST_SAME and share >= _SAME_SHARE:
            found.append((image_set.videos[pair[0]], image_set.videos[pair[1]]))
    return tuple(found)


def _with_parts(report: LinkReport, merged: MatchedImages, image_set: ImageSet) -> LinkReport:
    """Add the connected groups of several videos and photos to the report."""
    if image_set.num_sequences == 1:
        return report
    num_videos = len(image_set.videos)
    groups = _connected_sequences(merged, image_set)
    parts = [
        tuple(image_set.videos[sequence] for sequence in g if sequence < num_videos) for g in groups
    ]
    parts = [part for part in parts if part]
    alone = sorted(sequence for g in groups if min(g) >= num_videos for sequence in g)
    first = image_set.first_frame.tolist()
    return replace(
        report,
        videos=tuple(zip(image_set.videos, first, strict=False)) if num_videos > 1 else (),
        parts=tuple(parts) if len(parts) > 1 else (),
        unlinked_photos=tuple(
            image_set.images.names[image_set.images_of(sequence).start] for sequence in alone
        ),
    )


def _connected_sequences(matched: MatchedImages, image_set: ImageSet) -> list[list[int]]:
    """Group videos and photos that image pairs connect, the group with the most images first."""
    count = image_set.num_sequences
    # A sequence and a component of images are connected if they have an image in common.
    edges = np.column_stack([image_set.sequence, count + connected_images(matched)])
    label = connected_components(count + len(image_set.sequence), edges)[:count]
    parts = [np.flatnonzero(label == k).tolist() for k in np.unique(label)]
    size = np.bincount(image_set.sequence, minlength=count)
    return sorted(parts, key=lambda part: (-int(size[part].sum()), part))


def _largest_size(cameras: Sequence[pycolmap.Camera]) -> tuple[int, int]:
    """Smallest (width, height) that holds the pictures of all cameras."""
    return max(int(c.width) for c in cameras), max(int(c.height) for c in cameras)


# --- Merging the links with the matches of tracks.


def merge_links(
    matched: MatchedImages,
    links: Links,
    features: dict[int, Features],
    left_out: Sequence[int],
) -> MatchedImages:
    """Add linked features and their matches, and drop motion across the gaps `left_out`."""
    used: dict[int, set[int]] = {}
    for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True):
        used.setdefault(i, set()).update(geometry.inlier_matches[:, 0].tolist())
        used.setdefault(j, set()).update(geometry.inlier_matches[:, 1].tolist())
    num_tracks = max((int(k.track.max()) + 1 for k in matched.keypoints if k.track.size), default=0)
    keypoints = list(matched.keypoints)
    place: dict[int, NDArray[np.int64]] = {}
    for image, indices in used.items():
        keypoints[image], place[image] = _with_features(
            keypoints[image], features[image].xy, sorted(indices), num_tracks
        )
        num_tracks += len(indices)
    rows: dict[tuple[int, int], tuple[NDArray[np.uint32], TwoViewGeometry]] = {}
    gap = np.array(left_out, dtype=np.int64)
    for k, (i, j) in enumerate(matched.pairs.tolist()):
        if not np.any((i <= gap) & (gap < j)):
            rows[i, j] = matched.matches[k], matched.geometries[k]
    for k, (i, j) in enumerate(links.pairs.tolist()):
        geometry = links.geometries[k]
        inliers = np.column_stack(
            [place[i][geometry.inlier_matches[:, 0]], place[j][geometry.inlier_matches[:, 1]]]
        ).astype(np.uint32)
        own = replace(geometry, inlier_matches=inliers)
        if (i, j) in rows:
            rows[i, j] = _joined_matches(*rows[i, j], inliers, own)
        else:
            rows[i, j] = inliers, own
    order = sorted(rows)
    return replace(
        matched,
        keypoints=keypoints,
        pairs=np.array(order, dtype=np.int32).reshape(-1, 2),
        matches=[rows[pair][0] for pair in order],
        geometries=[rows[pair][1] for pair in order],
    )


def _with_features(
    keypoints: ImageKeypoints, xy: NDArray[np.float32], indices: list[int], first_track: int
) -> tuple[ImageKeypoints, NDArray[np.int64]]:
    """Add some features to keypoints; also return the index of each feature, -1 if not added.

    A feature that lies on a track's keypoint joins it; if there are several, the nearest does.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    place = np.full(len(xy), -1, dtype=np.int64)
    taken: dict[int, tuple[float, int]] = {}
    if len(keypoints.xy):
        distance, nearest = cKDTree(keypoints.xy).query(xy[indices])
        for index, d, k in zip(indices, distance.tolist(), nearest.tolist(), strict=True):
            if d <= _JOIN_DISTANCE and d < taken.get(k, (np.inf, 0))[0]:
                taken[k] = d, index
    for k, (_, index) in taken.items():
        place[index] = k
    new = [index for index in indices if place[index] < 0]
    place[new] = len(keypoints.xy) + np.arange(len(new))
    return (
        replace(
            keypoints,
            xy=np.concatenate([keypoints.xy, xy[new]]).astype(np.float32),
            track=np.concatenate([keypoints.track, first_track + np.arange(len(new))]),
        ),
        place,
    )


def _joined_matches(
    matches: NDArray[np.uint32],
    geometry: TwoViewGeometry,
    link_matches: NDArray[np.uint32],
    link: TwoViewGeometry,
) -> tuple[NDArray[np.uint32], TwoViewGeometry]:
    """Join the matches of tracks and of a link; keep the geometry that has more inliers."""

    def joined(a: NDArray[np.uint32], b: NDArray[np.uint32]) -> NDArray[np.uint32]:
        # A keypoint has one match per image; the match of its track takes precedence.
        free = ~np.isin(b[:, 0], a[:, 0]) & ~np.isin(b[:, 1], a[:, 1])
        return np.concatenate([a, b[free]])

    leading = geometry if len(geometry.inlier_matches) >= len(link.inlier_matches) else link
    if geometry.config == TwoViewConfig.DEGENERATE:
        leading = link
    inliers = joined(geometry.inlier_matches, link.inlier_matches)
    return joined(matches, link_matches), replace(leading, inlier_matches=inliers)


def links_as_tracks(
    links: Links,
    features: dict[int, Features],
    frames: NDArray[np.int32],
    num_frames: int,
    size: tuple[int, int],
) -> Tracks:
    """Convert links to tracks of connected features; drop tracks with two features in a frame."""
    images = sorted(features)
    counts = [len(features[i].xy) for i in images]
    first = dict(zip(images, np.concatenate([[0], np.cumsum(counts)])[:-1].tolist(), strict=True))
    total = int(sum(counts))
    ends = [
        geometry.inlier_matches.astype(np.int64) + np.array([first[i], first[j]])
        for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True)
    ]
    if not ends:
        return Tracks.empty(num_frames, size)
    label = connected_components(total, np.concatenate(ends))
    frame = np.repeat(frames[images], counts)
    size_of = np.bincount(label, minlength=label.max() + 1)
    order = np.lexsort((frame, label))
    order = order[size_of[label[order]] >= 2]
    twice = (np.diff(label[order]) == 0) & (np.diff(frame[order]) == 0)
    ambiguous = np.unique(label[order][1:][twice])
    order = order[~np.isin(label[order], ambiguous)]
    starts = np.flatnonzero(np.concatenate([[True], np.diff(label[order]) != 0]))
    if len(order) == 0:
        return Tracks.empty(num_frames, size)
    xy = np.concatenate([features[i].xy for i in images])
    return Tracks(
        num_frames=num_frames,
        width=size[0],
        height=size[1],
        offsets=np.append(starts, len(order)).astype(np.int64),
        frame=frame[order].astype(np.int32),
        xy=xy[order].astype(np.float32),
        sigma=np.full(len(order), _SIGMA, np.float32),
        confirmed=np.ones(len(order), np.bool_),
    )
