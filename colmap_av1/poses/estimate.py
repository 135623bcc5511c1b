"""The joint estimate of all poses: the sequence of its stages, for `match` and `reconstruct`."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import count
from typing import Any, Literal, TypeVar

from colmap_av1.errors import ModelError, VideoError
from colmap_av1.geometry.masks import Mask
from colmap_av1.geometry.posed_model import read_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.adjustment_stage import AdjustedResult, adjustment_stage
from colmap_av1.poses.dynamic.stage import (
    DynamicResult,
    dynamic_stage,
    read_dynamic_masks,
    without_dynamic_links,
    without_dynamic_tracks,
)
from colmap_av1.poses.long_range_stage import LongRangeResult, long_range_stage
from colmap_av1.poses.mapping_stage import (
    MappedResult,
    mapping_stage,
    num_nearest,
    with_model_first,
)
from colmap_av1.poses.match_stage import MatchesResult, match_stage, matches_key, read_links
from colmap_av1.poses.parts import certain_stage, split_stage
from colmap_av1.poses.posed_images import PosesResult
from colmap_av1.poses.remapping import remap_stage
from colmap_av1.poses.resection_stage import resection_stage
from colmap_av1.poses.run import Run
from colmap_av1.poses.track_stage import VideoTracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept, run_stage

_Decision = TypeVar("_Decision")

# Number of the adjustment after the first split; 1 and 2 follow the first and second mapping.
_FIRST_SPLIT = 3
# A second mapping of the first model must agree with this share of the observations.
_LEAST_KEPT = 0.9
# Poses without further links must have this share of the images of those with them.
_LEAST_SHARE = 0.5


@dataclass(frozen=True)
class Posed:
    """The finished stages of the joint estimate, and the tracks that agree with its poses.

    Attributes:
        matches: the database of the key images, see `match_stage`; that of the first model.
        mapped: the poses of the key images, see `mapping_stage`; after a second mapping or a split,
            those of all its images.
        resection: the poses of the images in between; None if all images are key images.
        dynamic: the dynamic objects; None if they were not looked for.
        adjustment: the adjusted poses; None if they are not adjusted.
        tracks: the tracks of all videos, cut at gaps that links replace and at seams of splits,
            without dynamic pixels.
        links: links as tracks, without dynamic pixels.
        dynamic_masks: masks that exclude dynamic objects, by image name.
        has_picture_positions: whether tracks have positions in the pictures; false if they were
            corrected for a rolling shutter.
        long_range: the long-range check; None if it was not made.
        rival: the adjustment of the first mapping if a second one replaced it, but fits the
            observations hardly better; else None.
    """

    matches: Kept[MatchesResult]
    mapped: Kept[MappedResult]
    resection: Kept[PosesResult] | None
    dynamic: Kept[DynamicResult] | None
    adjustment: Kept[AdjustedResult] | None
    tracks: Tracks
    links: Tracks
    dynamic_masks: dict[str, Mask]
    has_picture_positions: bool
    long_range: Kept[LongRangeResult] | None = None
    rival: Kept[AdjustedResult] | None = None

    @property
    def last(self) -> Kept[PosesResult]:
        """The stage with the final poses."""
        return self.adjustment or self.resection or self.mapped

    @property
    def masks_digest(self) -> str | None:
        """Digest of the stage that found dynamic objects; None if there are none."""
        return self.dynamic.digest if self.dynamic is not None and self.dynamic_masks else None

    @property
    def resumed(self) -> list[str]:
        """Names of the stages that an earlier run finished, in order."""
        stages: dict[str, Kept[object] | None] = {
            "matches": self.matches,
            "poses": self.mapped,
            "resection": self.resection,
            "dynamic": self.dynamic,
            "adjustment": self.adjustment,
            "long_range": self.long_range,
        }
        return [name for name, stage in stages.items() if stage is not None and stage.resumed]


@dataclass(frozen=True)
class _Mapped:
    """The matched images and the mapper's models of them.

    Attributes:
        matched: the database of the key images.
        keyed: the key images.
        models: the mapper's models.
    """

    matched: Kept[MatchesResult]
    keyed: ImageSet
    models: Kept[MappedResult]


@dataclass(frozen=True)
class _FirstModel:
    """Which of the mapper's models becomes the first.

    Attributes:
        file: the file of the model; None for the largest before models are split.
    """

    file: str | None


@dataclass(frozen=True)
class _FurtherLinks:
    """Where links are looked for after the first estimate.

    Attributes:
        doubted: frames after doubtful seams where no links were looked for.
        loops: whether to look for loop closures, because pictures far apart in time contradict the
            poses, and none were looked for.
        none: whether no links are used at all, because only poses with links are contradicted.
    """

    doubted: tuple[int, ...] = ()
    loops: bool = False
    none: bool = False


@dataclass(frozen=True)
class _FirstEstimate:
    """What the estimate without further links shows.

    Attributes:
        links: where links are looked for.
        may_be_right: whether pictures agree with the poses, or may agree after a split.
    """

    links: _FurtherLinks
    may_be_right: bool


def estimate_poses(run: Run, videos: Sequence[VideoTracks], image_set: ImageSet) -> Posed:
    """Estimate poses, and if they are doubtful estimate them again with further SIFT links.

    Links replace motion at doubtful seams. Loop closures are looked for if pictures far apart in
    time contradict the poses. A model that is still poorly connected is split, see `parts`. Links
    may follow an object that moves. If pictures contradict only the poses with further links, those
    without these are used; if they contradict all poses with links, those without any links are
    used, unless they contradict these as well. If another of the mapper's models is larger than the
    largest part, it becomes the first.
    """
    options = run.options
    key = [matches_key(run, videos, image_set), options.mapping, options.moving != "keep"]
    no_links = _FurtherLinks()

    def run_with(links: _FurtherLinks) -> Run:
        if links.none:
            return _with_links(run, "none")
        return _with_links(run, "sift") if links.loops else run

    # The caches hold only the last result, because estimates are large. A resumed run whose
    # decisions are stored makes only the final estimate.
    @lru_cache(maxsize=1)
    def map_key_images(links: _FurtherLinks) -> _Mapped:
        return _map_key_images(run_with(links), videos, image_set, doubted=links.doubted)

    @lru_cache(maxsize=1)
    def pose(links: _FurtherLinks, first: str | None) -> Posed:
        return _pose_images(run_with(links), videos, image_set, map_key_images(links), first)

    @lru_cache(maxsize=1)
    def split(links: _FurtherLinks, first: str | None) -> Posed:
        return split_at_seams(run_with(links), pose(links, first), image_set)

    def forget() -> None:
        """Clear the caches: after an error, the stages on disk are those of other links."""
        for made in (map_key_images, pose, split):
            made.cache_clear()

    def look_for_errors() -> _FirstEstimate:
        posed = pose(no_links, None)
        links = _FurtherLinks(
            doubted=tuple(_unlinked_seams(run, image_set, posed)),
            loops=_needs_loops(run, posed),
        )
        may_be_right = not _is_contradicted(posed) or bool(_seams_to_split(posed))
        return _FirstEstimate(links, may_be_right)

    def choose_links() -> _FurtherLinks:
        links = first_estimate.links
        if links == no_links:
            return no_links
        try:
            posed = split(links, None)
        except ModelError:  # the poses without them can be used
            forget()
            return no_links
        if not first_estimate.may_be_right or not _is_contradicted(posed):
            return links
        size = posed.last.result.num_registered
        del posed
        pose.cache_clear()
        split.cache_clear()
        plain = split(no_links, None)
        is_large = plain.last.result.num_registered >= _LEAST_SHARE * size
        return no_links if is_large and not _is_contradicted(plain) else links

    def leave_links_out() -> _FurtherLinks:
        posed = split(further, None)
        may_mislead = options.match.links.links == "auto" and posed.links.num_tracks > 0
        # Several videos, and photos, are connected by links only.
        is_one_video = image_set.num_sequences == 1
        if not (may_mislead and is_one_video and _is_contradicted(posed)):
            return further
        size = posed.last.result.num_registered
        del posed
        forget()
        none = _FurtherLinks(none=True)
        try:
            plain = split(none, None)
        except (ModelError, VideoError):  # without links, there may be nothing to match
            forget()
            return further
        is_large = plain.last.result.num_registered >= _LEAST_SHARE * size
        return none if is_large and _is_confirmed(plain) else further

    def choose_model() -> _FirstModel:
        largest_part = split(links, None)
        size = largest_part.last.result.num_registered
        if largest_part is pose(links, None):  # it was not split
            return _FirstModel(None)
        other = _larger_model(run, map_key_images(links), size, image_set)
        if other is None:
            return _FirstModel(None)
        del largest_part
        pose.cache_clear()
        split.cache_clear()
        try:
            posed = split(links, other)
        except ModelError:  # too few tracks agree with its poses
            return _FirstModel(None)
        is_larger = posed.last.result.num_registered > size
        return _FirstModel(other if is_larger and not _is_contradicted(posed) else None)

    first_estimate = _decided(run, "first_estimate", key, _FirstEstimate, look_for_errors)
    further = _decided(run, "further_links", [key, first_estimate], _FurtherLinks, choose_links)
    links = _decided(run, "links", [key, further], _FurtherLinks, leave_links_out)
    first = _decided(run, "first_model", [key, links], _FirstModel, choose_model).file
    return split(links, first)


def _decided(
    run: Run,
    name: str,
    key: Sequence[Any],
    kind: type[_Decision],
    make: Callable[[], _Decision],
) -> _Decision:
    """The result of a stage without products."""
    return run_stage(run.stages, name, key, kind, products=[], make=lambda _: make()).result


def _larger_model(run: Run, mapped: _Mapped, size: int, image_set: ImageSet) -> str | None:
    """The file of the mapper's second model; None if it has no more than `size` images."""
    others = mapped.models.result.other_models  # sorted by size
    if not others:
        return None
    second = read_posed_model(run.stages / others[0])
    return others[0] if num_nearest(second, image_set, mapped.keyed) > size else None


def split_at_seams(
    run: Run, posed: Posed, image_set: ImageSet, *, only_certain: bool = False
) -> Posed:
    """Split the model at seams with few points, and adjust the largest part separately.

    If pictures far apart in time contradict the poses, it is split at doubtful seams, too. The
    separate adjustment may change the number of points at a seam, so the seams of the largest part
    are checked again until no split is left. Motion across a seam is not used any more, because it
    may be wrong there. Links are: without them, a part that returns to a place would fall apart.

    Images of a model with such seams are also removed if their positions are uncertain, see
    `certain_parts`.

    Args:
        run: the run.
        posed: the adjusted poses.
        image_set: the images.
        only_certain: remove images with uncertain positions even if there are no such seams.

    Returns:
        The poses of the largest part. If too few of its images are certain, it is returned with all
        of them; with `only_certain`, its mapped model then has no images, and the poses of the
        other stages must not be used.
    """
    may_bend = only_certain
    for number in count(_FIRST_SPLIT):
        if posed.adjustment is None:
            break
        seams, num_images = _seams_to_split(posed), posed.adjustment.result.num_registered
        may_bend |= bool(seams)
        parts = None
        if seams:
            parts = split_stage(
                run,
                image_set,
                posed.mapped,
                posed.adjustment,
                seams,
                rival=posed.rival,
                number=number,
            )
        if parts is None or parts.result.num_registered == num_images:
            if not may_bend:
                break
            seams = []
            parts = certain_stage(run, image_set, posed.mapped, posed.adjustment, number=number)
            if parts.result.num_registered == num_images:
                break
        if parts.result.num_registered == 0:
            return replace(posed, mapped=parts) if only_certain else posed
        frame_of = image_set.images.frame_of
        frames = [frame_of[first] for first, _ in seams]
        posed = replace(
            posed,
            mapped=parts,
            tracks=posed.tracks.split_after_frames(frames),
        )
        posed = replace(posed, adjustment=_adjusted(run, posed, image_set, parts, number=number))
        if posed.long_range is not None:
            posed = replace(posed, long_range=_long_range_check(run, posed, image_set))
    return posed


def _seams_to_split(posed: Posed) -> list[tuple[str, str]]:
    """Names of the images before and after each seam to split the model at."""
    if posed.adjustment is None:
        return []
    adjusted = posed.adjustment.result
    seams = adjusted.doubtful_seams if _is_contradicted(posed) else adjusted.few_point_seams
    return sorted({*seams, *adjusted.scale_lost_seams})


def _is_contradicted(posed: Posed) -> bool:
    """Whether pictures far apart in time contradict the poses."""
    return posed.long_range is not None and posed.long_range.result.contradicts_poses


def _is_confirmed(posed: Posed) -> bool:
    """Whether pictures far apart in time agree with the poses."""
    is_seen = posed.long_range is not None and posed.long_range.result.median is not None
    return is_seen and not _is_contradicted(posed)


def _needs_loops(run: Run, posed: Posed) -> bool:
    """Whether pictures far apart contradict the poses, and no loop closures were looked for."""
    looked = run.options.match.links.links != "auto" or posed.matches.result.links.searched_all
    return _is_contradicted(posed) and not looked


def _with_links(run: Run, links: Literal["sift", "none"]) -> Run:
    """The run with loop closures in all videos, or without links."""
    match = run.options.match
    match = replace(match, links=replace(match.links, links=links))
    return replace(run, options=replace(run.options, match=match))


def _unlinked_seams(run: Run, image_set: ImageSet, posed: Posed) -> list[int]:
    """Frames after doubtful seams where no links were looked for."""
    if posed.adjustment is None or run.options.match.links.links == "none":
        return []
    frame_of = image_set.images.frame_of
    links = posed.matches.result.links
    looked_at = [*links.frames_of_gaps(), *links.fast]
    seams = [
        (frame_of[first], frame_of[second])
        for first, second in posed.adjustment.result.doubtful_seams
    ]
    return [
        after
        for before, after in seams
        if not any(first <= before and after <= last for first, last in looked_at)
    ]


def _map_key_images(
    run: Run, videos: Sequence[VideoTracks], image_set: ImageSet, *, doubted: Sequence[int]
) -> _Mapped:
    """Match and map the key images; `doubted` as in `match_stage`."""
    matched = match_stage(run, videos, image_set, doubted)
    depth = matched.result.depth
    if not depth.is_observable:
        raise ModelError(f"{run.inputs.name}: {depth.warning}")
    keyed = image_set.some(matched.result.key_images)
    return _Mapped(matched, keyed, mapping_stage(run, matched, image_set, keyed))


def _pose_images(
    run: Run,
    videos: Sequence[VideoTracks],
    image_set: ImageSet,
    found: _Mapped,
    first: str | None,
) -> Posed:
    """Resect and adjust.

    Args:
        run: the run.
        videos: the tracks of each video.
        image_set: the images.
        found: the mapper's models.
        first: file of the one to continue with; None for the largest.
    """
    mapped = found.models
    if first is not None:
        mapped = with_model_first(run, mapped, first)
    # Without a read-out time the tracks were not corrected.
    has_picture_positions = not any(own.read_out for own in videos)
    trusted = trusted_tracks(run, [own.tracks for own in videos], image_set)
    posed = refined_poses(
        run,
        found.matched,
        mapped,
        trusted=trusted,
        image_set=image_set,
        keyed=found.keyed,
        has_picture_positions=has_picture_positions,
    )
    if _is_doubtful(posed):
        posed = remapped_poses(run, posed, image_set, least_kept=_LEAST_KEPT)
    return replace(posed, long_range=_long_range_check(run, posed, image_set))


def _long_range_check(run: Run, posed: Posed, image_set: ImageSet) -> Kept[LongRangeResult]:
    """The long-range check of the poses."""
    return long_range_stage(
        run,
        posed.tracks,
        image_set,
        posed.dynamic_masks,
        posed.last,
        masks_digest=posed.masks_digest,
        linked=posed.matches.result.links.searched_all,
    )


def trusted_tracks(
    run: Run, tracks: Sequence[Tracks], image_set: ImageSet
) -> tuple[Tracks, Tracks]:
    """The tracks of all videos, cut at gaps that links replace, and the links."""
    links, broken = read_links(run.stages)
    every = Tracks.in_sequence(tracks, image_set.num_frames)
    return every.split_after_frames(broken.tolist()), links


def _is_doubtful(posed: Posed) -> bool:
    """Whether the adjusted model may have a wrong focal length, or bend where links replace motion.

    It may bend if points connect it poorly somewhere, or if it was mapped with an assumed focal
    length.
    """
    if posed.adjustment is None:
        return False
    matches, adjusted = posed.matches.result, posed.adjustment.result
    is_weak = adjusted.doubtful_seams or adjusted.scale_lost_seams or matches.assumes_focal_length
    may_bend = (matches.links.gaps or matches.links.fast) and is_weak
    return bool(adjusted.has_long_focal_length or may_bend)


def remapped_poses(run: Run, posed: Posed, image_set: ImageSet, *, least_kept: float) -> Posed:
    """Map the images again from the adjusted observations, and use that unless its cost is higher.

    See `remapping`. Nothing is mapped again if the adjustment did not use corners.

    Args:
        run: the run.
        posed: the adjusted poses.
        image_set: the images.
        least_kept: the second mapping is rejected if a smaller share of the observations agrees
            with it.
    """
    if posed.adjustment is None or not posed.has_picture_positions:
        return posed
    again = remap_stage(run, image_set, posed.mapped, posed.adjustment)
    if not again.result.fits(least_kept):
        return posed
    rival = None if again.result.is_clearly_better else posed.adjustment
    posed = replace(posed, mapped=again, rival=rival)
    return replace(posed, adjustment=_adjusted(run, posed, image_set, again, number=2))


def _adjusted(
    run: Run, posed: Posed, image_set: ImageSet, poses: Kept[PosesResult], *, number: int = 1
) -> Kept[AdjustedResult]:
    """Adjust poses, see `adjustment_stage`."""
    return adjustment_stage(
        run,
        posed.tracks,
        posed.links,
        image_set,
        poses,
        dynamic_masks=posed.dynamic_masks,
        masks_digest=posed.masks_digest,
        has_picture_positions=posed.has_picture_positions,
        is_fast=bool(posed.matches.result.links.fast),
        number=number,
    )


def refined_poses(
    run: Run,
    matched: Kept[MatchesResult],
    mapped: Kept[MappedResult],
    *,
    trusted: tuple[Tracks, Tracks],
    image_set: ImageSet,
    keyed: ImageSet,
    has_picture_positions: bool,
) -> Posed:
    """Estimate the poses of the images between the key images, and adjust all poses.

    Args:
        run: the run.
        matched: the database that was mapped.
        mapped: the poses of the mapper.
        trusted: the tracks and links, see `trusted_tracks`.
        image_set: the images.
        keyed: the key images.
        has_picture_positions: see `Posed`.
    """
    tracks, links = trusted
    resection = dynamic = None
    poses: Kept[PosesResult] = mapped
    if len(keyed.sequence) < len(image_set.sequence):
        poses = resection = resection_stage(run, tracks, image_set, keyed, mapped)
    dynamic_masks: dict[str, Mask] = {}
    if run.options.moving != "keep":
        dynamic = dynamic_stage(run, tracks, image_set, poses)
        dynamic_masks = read_dynamic_masks(run.stages)
    tracks = without_dynamic_tracks(tracks, image_set, dynamic_masks, run)
    links = without_dynamic_links(links, image_set, dynamic_masks)
    posed = Posed(
        matches=matched,
        mapped=mapped,
        resection=resection,
        dynamic=dynamic,
        adjustment=None,
        tracks=tracks,
        links=links,
        dynamic_masks=dynamic_masks,
        has_picture_positions=has_picture_positions,
    )
    if not run.options.mapping.adjust:
        return posed
    return replace(posed, adjustment=_adjusted(run, posed, image_set, poses))
