"""Link images by SIFT features where motion does not connect them.

Motion vectors connect images that are neighbours in time. At gaps (the camera jerks, a picture is
blurred) and at loop closures, SIFT features are extracted from a few pictures. The features across
a gap also decide whether the motion across it is kept.

The steps: plan which pictures are examined and which pairs are tried; match their features; compare
them with the motion across gaps; merge them with the matches of tracks.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.geometry.cameras import largest_size
from colmap_av1.images.image_set import ImageSet, Pictures
from colmap_av1.matching.features.overlays import without_overlays
from colmap_av1.matching.features.sift import Features
from colmap_av1.matching.gaps import suspect_gaps
from colmap_av1.matching.links.evidence import (
    contradicted_gaps,
    gaps_after_linking,
    same_videos,
    unbridged_gaps,
    with_parts,
)
from colmap_av1.matching.links.matching import (
    Links,
    features_of_images,
    loop_pairs,
    match_pairs,
    neighbour_pairs,
    pairs_between,
    supported_links,
)
from colmap_av1.matching.links.merging import links_as_tracks, merge_links
from colmap_av1.matching.links.plan import (
    Plan,
    first_look,
    plan_links,
    searches_all,
    spread_over_videos,
    thorough_plan,
)
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.matched_images import MatchedImages, nothing_to_match
from colmap_av1.options import LinkOptions, PairOptions, VerifyOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.spread import evenly_spread

# If features link two neighbours with this many inliers while the camera moves fast, the motion
# across them is dropped.
_FAST_INLIERS = 50
# A video without any motion has no detail if its images have fewer features than this; others have
# hundreds. The second value is the number of images examined.
_FEW_FEATURES = 20
_NUM_SAMPLES = 3


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
    fast: Bools,
    pairs: PairOptions,
    verify: VerifyOptions,
    links: LinkOptions,
    context: RunContext,
    name: str,
    images_apart: float,
) -> LinkedImages:
    """Link images by SIFT features where motion does not connect them.

    No picture is decoded if motion connects all images of a single video, is trusted everywhere,
    and reaches over a large part of it.

    Args:
        image_set: the images of videos and photos.
        matched: the images, matched along tracks.
        cameras: the camera of each image; images that share a camera hold the same object.
        inter_share: float32 [n] share of inter units of each frame of the videos, one after the
            other, see `TrackedVideo`.
        pictures: returns the pictures of images.
        fast: bool [m] images of the videos around which the camera moves fast, see `fast_frames`.
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

    def find(plan: Plan) -> _FoundLinks:
        features = features_of(plan.wanted, plan.effort)
        with context.clock.measure("links"):
            return _find_links(
                plan,
                image_set,
                matched,
                cameras,
                without_overlays(features, cameras),
                offsets=pairs.offsets,
                verify=verify,
                options=links,
                context=context,
            )

    def link(plan: Plan) -> LinkedImages:
        own = find(plan)
        with context.clock.measure("links"):
            return _with_links(plan, own, image_set, matched, cameras)

    suspect = suspect_gaps(image_set, matched, inter_share, links)
    gaps = suspect.certain
    plan = plan_links(image_set, matched, gaps, images_apart, links, fast=fast)
    if links.links != "none" and (suspect.maybe.any() or suspect.probes):
        first = first_look(suspect, image_set)
        also = plan.wanted if plan.effort == "light" else []
        features_of([*first.wanted, *also], "light")  # decodes the videos only once
        gaps = gaps | unbridged_gaps(find(first).contradicted, suspect, matched, image_set)
        plan = plan_links(image_set, matched, gaps, images_apart, links, fast=fast)
    if plan.wanted:
        linked = link(plan)
    else:
        nothing = Tracks.empty(image_set.num_frames, largest_size(cameras))
        linked = LinkedImages(matched, nothing, with_parts(LinkReport(), matched, image_set))
    if linked.report.frames_of_gaps("no overlap" if plan.loop else "few tracks"):
        # The scene on either side of a cut may reappear anywhere in the videos.
        loop = sorted({*plan.loop, *spread_over_videos(image_set, matched, images_apart)})
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
    report = replace(
        linked.report,
        num_images=len(examined),
        searched_loops=searches_all(plan, image_set, matched, images_apart),
    )
    return replace(linked, report=report)


@dataclass(frozen=True)
class _FoundLinks:
    """The links of a plan.

    Attributes:
        links: the links.
        features: the features of each examined image.
        num_loop_closures: number of linked pairs that close a loop.
        num_between: number of linked pairs of different videos or photos.
        contradicted: the gaps of the plan whose motion the pictures contradict.
    """

    links: Links
    features: dict[int, Features]
    num_loop_closures: int
    num_between: int
    contradicted: list[int]


def _find_links(
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
) -> _FoundLinks:
    """Match the images of a plan by their features, see `link_images`.

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
    loops = loop_pairs(image_set, matched, plan.loop, features, options, seed=context.seed) - across
    between = pairs_between(plan.between, features, image_set, options, seed=context.seed)
    tried = across | loops | between
    links = supported_links(
        matched_pairs(tried), loops | between, sorted({*plan.loop, *plan.between}), image_set
    )
    found = {tuple(pair) for pair in links.pairs.tolist()}
    neighbours = neighbour_pairs(links, plan.between, image_set) - tried
    if neighbours:
        links = links.joined(matched_pairs(neighbours))
    return _FoundLinks(
        links,
        features,
        num_loop_closures=len(loops & found),
        num_between=len(between & found),
        contradicted=contradicted_gaps(plan.gaps, links, matched, cameras),
    )


def _with_links(
    plan: Plan,
    found: _FoundLinks,
    image_set: ImageSet,
    matched: MatchedImages,
    cameras: Sequence[pycolmap.Camera],
) -> LinkedImages:
    """Merge the links of a plan with the matches of tracks."""
    links, features, contradicted = found.links, found.features, found.contradicted
    in_fast = {image for images in plan.fast for image in images[:-1]}
    linked = [
        i
        for (i, j), geometry in zip(links.pairs.tolist(), links.geometries, strict=True)
        if j == i + 1 and i in in_fast and len(geometry.inlier_matches) >= _FAST_INLIERS
    ]
    merged = merge_links(matched, links, features, [*contradicted, *linked])
    report = LinkReport(
        num_links=len(links.pairs),
        num_loop_closures=found.num_loop_closures,
        num_between=found.num_between,
        gaps=gaps_after_linking(plan.gaps, contradicted, merged, image_set),
        fast=tuple(
            (int(image_set.images.frames[own[0]]), int(image_set.images.frames[own[-1]]))
            for own in plan.fast
        ),
        same_videos=same_videos(links, features, cameras, image_set),
    )
    tracks = links_as_tracks(
        links, features, image_set.images.frames, image_set.num_frames, largest_size(cameras)
    )
    return LinkedImages(merged, tracks, with_parts(report, merged, image_set))
