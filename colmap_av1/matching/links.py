"""Links: matches of pictures where motion does not connect images that see the same.

Motion vectors link neighbours in time. Where a camera jerks, a picture is blurred or a place is
seen again, a few pictures get light SIFT features. What these say of a gap decides, too, whether
the motion across it is believed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import VideoError
from colmap_av1.images.takes import Pictures, Takes
from colmap_av1.matching.features.overlays import without_overlays
from colmap_av1.matching.features.sift import Features
from colmap_av1.matching.image_matches import MatchedImages, nothing_to_match
from colmap_av1.matching.link_matches import (
    Links,
    broken_gaps,
    extract_features,
    match_pairs,
    same_videos,
    supported_links,
)
from colmap_av1.matching.link_merging import (
    connected_images,
    links_as_tracks,
    merge_links,
)
from colmap_av1.matching.link_plan import (
    Plan,
    groups_of_takes,
    pairs_beside,
    pairs_between,
    places_of,
    plan_anywhere,
    plan_links,
    revisit_pairs,
    thorough_plan,
    weak_and_probed_gaps,
)
from colmap_av1.options import MatchOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.progress import Clock, Progress

# Inliers across a gap from which on mappers take it: they register an image by 30 points of its,
# of which matches of two images give a part.
_SURE_INLIERS = 100
# Share of the usual inliers between neighbours from which on motion that agrees with the pictures
# carries over a gap by itself.
_ENOUGH_OF_USUAL = 0.3
# Gaps of a video that are probed and contradicted by pictures, which prove its motion wrong.
_NUM_BROKEN_PROBES = 2
# Features of a picture below which it shows nothing: others have hundreds.
_FEW_FEATURES = 20
# Images of a video without any motion whose pictures are looked at, to tell whether they show
# anything.
_NUM_GLANCED = 3
# Gaps that a warning names.
_NUM_NAMED = 4


@dataclass(frozen=True)
class LinkReport:
    """What linking found.

    Frames of several videos are counted through.

    Attributes:
        num_images: images whose pictures were looked at.
        looked_again: places seen again were looked for.
        num_tried: pairs whose features were matched.
        num_links: pairs that were linked.
        num_revisits: those of them that see a place again.
        num_between: those of different videos, or of photos.
        weak_gaps: (frame, frame) on either side of gaps that motion does not carry over.
        broken_gaps: those whose motion contradicts the pictures, or is not confirmed by them: its
            matches are left out.
        doubtful_gaps: those that few matches of any kind cross: a mapper may part the images there.
        open_gaps: those across which neither motion nor pictures connect the images.
        videos: (name, first frame) of each video where there are several.
        parts: the videos, by groups that are connected, where nothing connects them all.
        unlinked_photos: names of photos that nothing connects with a video.
        same_videos: (name, name) of videos that show the same pictures.
    """

    num_images: int = 0
    looked_again: bool = False
    num_tried: int = 0
    num_links: int = 0
    num_revisits: int = 0
    num_between: int = 0
    weak_gaps: tuple[tuple[int, int], ...] = ()
    broken_gaps: tuple[tuple[int, int], ...] = ()
    doubtful_gaps: tuple[tuple[int, int], ...] = ()
    open_gaps: tuple[tuple[int, int], ...] = ()
    videos: tuple[tuple[str, int], ...] = ()
    parts: tuple[tuple[str, ...], ...] = ()
    unlinked_photos: tuple[str, ...] = ()
    same_videos: tuple[tuple[str, str], ...] = ()

    @property
    def warnings(self) -> tuple[str, ...]:
        """What the user should know: images that nothing connects, videos that are the same."""
        same = (
            f"'{first}' and '{second}' show the same pictures, as encodings of one video do: give "
            "one of them, the other adds nothing but time"
            for first, second in self.same_videos
        )
        return (*self._open_gaps(), *self._parts(), *self._unlinked_photos(), *same)

    def _open_gaps(self) -> tuple[str, ...]:
        if not self.open_gaps:
            return ()
        shown = ", ".join(self._frames(gap) for gap in self.open_gaps[:_NUM_NAMED])
        more = len(self.open_gaps) - _NUM_NAMED
        return (
            f"nothing connects frames {shown}{f' and {more} more pairs' if more > 0 else ''}: the "
            "camera jerks, or the pictures are blurred or cut there, and show nothing in common; "
            "the images on either side become separate models",
        )

    def _frames(self, gap: tuple[int, int]) -> str:
        """The frames of a gap, counted in their own video."""
        name, before, after = gap_in_video(gap, self.videos)
        return f"{before} and {after} of '{name}'" if name else f"{before} and {after}"

    def _parts(self) -> tuple[str, ...]:
        if not self.parts:
            return ()
        if self.num_images == 0:
            names = ", ".join(f"'{name}'" for part in self.parts for name in part)
            return (f"links none leaves {names} unconnected: they become separate models",)
        groups = " from ".join(", ".join(f"'{name}'" for name in part) for part in self.parts)
        return (
            f"nothing in the pictures connects {groups}: they become {len(self.parts)} separate "
            "models; film what both see, or match videos of different scenes apart",
        )

    def _unlinked_photos(self) -> tuple[str, ...]:
        if not self.unlinked_photos:
            return ()
        names = ", ".join(f"'{name}'" for name in self.unlinked_photos[:_NUM_NAMED])
        more = ", ..." if len(self.unlinked_photos) > _NUM_NAMED else ""
        return (
            f"{len(self.unlinked_photos)} photos show nothing that a video shows, and are "
            f"connected to none: {names}{more}",
        )


def gap_in_video(gap: Sequence[int], videos: Sequence[tuple[str, int]]) -> tuple[str, int, int]:
    """The frames of a gap counted in their own video, after its name; '' where there is one."""
    name, first = next((v for v in reversed(videos) if v[1] <= gap[0]), ("", 0))
    return name, gap[0] - first, gap[1] - first


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


def link_images(
    takes: Takes,
    matched: MatchedImages,
    cameras: Sequence[Any],
    inter_share: NDArray[np.float32],
    pictures: Pictures,
    *,
    name: str,
    images_apart: float = 1.0,
    options: MatchOptions,
    clock: Clock,
    progress: Progress,
) -> LinkedImages:
    """Link images by their pictures where motion does not connect them.

    No picture is decoded where motion connects all images, as it may those of one video.

    Args:
        takes: the images of videos and photos.
        matched: the images, matched along tracks.
        cameras: the camera of each image; images share one where it is the same object.
        inter_share: float32 [num_frames], see `TrackedVideo`; any numbers for photos.
        pictures: gives the pictures of images.
        name: what messages call the videos.
        images_apart: images that each of these stands for, where they are a choice of many.
        options: those of links, verification and reading are used.
        clock: gets the stage "links".
        progress: called for the stage "links".

    Raises:
        VideoError: neither motion nor pictures connect any two images.
    """
    found: dict[str, dict[int, Features]] = {"light": {}, "full": {}}

    def look_at(wanted: Iterable[int], effort: Literal["light", "full"]) -> dict[int, Features]:
        known = found[effort]
        missing = sorted(set(wanted) - known.keys())
        with clock.measure("links"):
            known |= extract_features(
                *(missing, pictures, cameras, takes.masks, options.links),
                effort=effort,
                progress=progress,
            )
        return {image: known[image] for image in wanted if image in known}

    def link(plan: Plan) -> LinkedImages:
        features = look_at(plan.wanted, plan.effort)
        with clock.measure("links"):
            features = without_overlays(features, cameras)
            return _link(
                *(plan, takes, matched, cameras, features), options=options, progress=progress
            )

    weak, maybe, probes = weak_and_probed_gaps(takes, matched, inter_share, options.links)
    plan = plan_links(takes, matched, weak, images_apart, options.links)
    if options.links.links != "none" and (maybe.any() or probes):
        first = Plan.of_first_look(np.flatnonzero(maybe), probes, takes)
        look_at([*first.wanted, *plan.wanted], "light")  # the videos are decoded once
        weak |= _proved_weak(link(first).report, maybe, probes, matched, takes)
        plan = plan_links(takes, matched, weak, images_apart, options.links)
    if plan.wanted:
        linked = link(plan)
    else:
        nothing = Tracks.empty(takes.num_frames, _largest(cameras))
        linked = LinkedImages(matched, nothing, LinkReport(**_take_report(matched, takes)))
    if linked.report.doubtful_gaps and not plan.key:
        plan = plan_anywhere(plan, takes, matched, images_apart)
        linked = link(plan)
    if plan.wanted and (linked.report.doubtful_gaps or linked.report.parts):
        linked = link(thorough_plan(plan, takes))
    if len(linked.matched.pairs) == 0:
        if options.links.links != "none" and not found["light"]:
            look_at(np.linspace(0, len(takes.take) - 1, _NUM_GLANCED).round().astype(int), "light")
        sizes = [len(features.xy) for features in found["light"].values()]
        if sizes and np.median(sizes) < _FEW_FEATURES:
            raise VideoError(
                f"{name}: its pictures show hardly any detail, {np.median(sizes):.0f} features "
                "each, so there is nothing to match: film what has texture, in light and in focus"
            )
        raise nothing_to_match(name, options)
    looked_at = found["light"].keys() | found["full"].keys()
    return replace(linked, report=replace(linked.report, num_images=len(looked_at)))


def _proved_weak(
    report: LinkReport,
    maybe: NDArray[np.bool_],
    probes: list[int],
    matched: MatchedImages,
    takes: Takes,
) -> NDArray[np.bool_]:
    """The gaps whose motion a look at few pictures does not bear out, or where it is little.

    All gaps of a video are weak where several of its probes are wrong.

    Args:
        report: of the look.
        maybe: bool [num_images - 1] gaps that may be weak.
        probes: other gaps that stand for all of them.
        matched: the images, matched along tracks.
        takes: the images.
    """
    wrong = {frame for frame, _ in report.broken_gaps}
    is_wrong = np.isin(takes.images.frames[:-1], sorted(wrong))
    across = np.zeros(len(maybe))
    for (i, j), geometry in zip(matched.pairs.tolist(), matched.geometries, strict=True):
        if j == i + 1:
            across[i] = len(geometry.inlier_matches)
    enough = max(_SURE_INLIERS, _ENOUGH_OF_USUAL * float(np.median(across)))
    proved = maybe & (is_wrong | (across < enough))
    broken = [int(takes.take[gap]) for gap in probes if is_wrong[gap]]
    for take, count in enumerate(np.bincount(broken, minlength=takes.num_takes).tolist()):
        if count >= _NUM_BROKEN_PROBES:
            images = takes.images_of(take)
            proved[images.start : images.stop - 1] = True
    return proved


def _largest(cameras: Sequence[Any]) -> tuple[int, int]:
    """(width, height) that holds the pictures of all cameras."""
    return max(int(c.width) for c in cameras), max(int(c.height) for c in cameras)


def _link(
    plan: Plan,
    takes: Takes,
    matched: MatchedImages,
    cameras: Sequence[Any],
    features: dict[int, Features],
    *,
    options: MatchOptions,
    progress: Progress,
) -> LinkedImages:
    """Link the images of a plan by their features, see `link_images`."""
    gaps = plan.gaps

    def matched_pairs(pairs: set[tuple[int, int]]) -> Links:
        return match_pairs(
            np.array(sorted(pairs), dtype=np.int32).reshape(-1, 2),
            features,
            cameras=cameras,
            verify=options.verify,
            run=options.run,
            progress=progress,
        )

    gap_pairs = {(i, j) for images in plan.around for i in images for j in images if i < j}
    revisits = revisit_pairs(takes, matched, plan.key, features, options) - gap_pairs
    between = pairs_between(plan.between, features, takes, options)
    place = places_of(sorted({*plan.key, *plan.between}), takes)
    photos = set(range(takes.images_of(len(takes.videos)).start, len(takes.take)))
    tried = gap_pairs | revisits | between
    links = supported_links(matched_pairs(tried), revisits | between, place, photos)
    found = {tuple(pair) for pair in links.pairs.tolist()}
    beside = pairs_beside(links, plan.between, takes) - tried
    if beside:
        links = links.joined(matched_pairs(beside))
    broken = broken_gaps(gaps, links, matched, cameras)
    merged = merge_links(matched, links, features, broken)
    same = same_videos(links, features, cameras, takes)
    report = LinkReport(
        num_images=len(plan.wanted),
        looked_again=bool(plan.key),
        num_tried=len(tried | beside),
        num_links=len(links.pairs),
        num_revisits=len(revisits & found),
        num_between=len(between & found),
        same_videos=tuple((takes.videos[a], takes.videos[b]) for a, b in same),
        **_gap_report(gaps, broken, merged, takes),
        **_take_report(merged, takes),
    )
    frames = takes.images.frames
    tracks = links_as_tracks(links, features, frames, takes.num_frames, _largest(cameras))
    return LinkedImages(merged, tracks, report)


def _gap_report(
    gaps: NDArray[np.int64], broken: Sequence[int], merged: MatchedImages, takes: Takes
) -> dict[str, Any]:
    """The attributes of `LinkReport` that are about gaps."""
    frames = takes.images.frames
    group = connected_images(merged)

    def between(which: Sequence[int]) -> tuple[tuple[int, int], ...]:
        return tuple((int(frames[g]), int(frames[g + 1])) for g in which)

    every = gaps.tolist()
    return {
        "weak_gaps": between(every),
        "broken_gaps": between(broken),
        "doubtful_gaps": between([gap for gap in every if _is_doubtful(gap, merged, takes)]),
        "open_gaps": between([gap for gap in every if group[gap] != group[gap + 1]]),
    }


def _take_report(merged: MatchedImages, takes: Takes) -> dict[str, Any]:
    """The attributes of `LinkReport` that are about several videos and photos."""
    if takes.num_takes == 1:
        return {}
    num_videos = len(takes.videos)
    groups = groups_of_takes(merged, takes)
    parts = [tuple(takes.videos[take] for take in g if take < num_videos) for g in groups]
    parts = [part for part in parts if part]
    alone = [take for g in groups if min(g) >= num_videos for take in g]
    first = takes.first_frame.tolist()
    return {
        "videos": tuple(zip(takes.videos, first, strict=False)) if num_videos > 1 else (),
        "parts": tuple(parts) if len(parts) > 1 else (),
        "unlinked_photos": tuple(
            takes.images.names[takes.images_of(take).start] for take in sorted(alone)
        ),
    }


def _is_doubtful(gap: int, matched: MatchedImages, takes: Takes) -> bool:
    """Whether no pair of images across a gap has the inliers that a mapper is sure of."""
    take = takes.take[matched.pairs]
    crossing = (matched.pairs[:, 0] <= gap) & (matched.pairs[:, 1] > gap)
    crossing &= take[:, 0] == take[:, 1]
    inliers = [len(matched.geometries[k].inlier_matches) for k in np.flatnonzero(crossing)]
    return max(inliers, default=0) < _SURE_INLIERS
