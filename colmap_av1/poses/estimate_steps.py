"""The sequence of stages that estimates all poses.

The key images are matched and mapped, the poses of the images in between are found by resection,
dynamic objects are masked, and all poses are adjusted. Doubtful models are mapped again from their
adjusted observations, and split at seams that hardly any points connect.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count

from colmap_av1.errors import ModelError
from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.track_images import VideoTracks
from colmap_av1.poses.adjustment_stage import AdjustedResult, adjustment_stage
from colmap_av1.poses.dynamic.stage import DynamicResult, dynamic_stage, without_dynamic
from colmap_av1.poses.estimate_tracks import EstimateTracks
from colmap_av1.poses.false_links import leaping_seams
from colmap_av1.poses.long_range_stage import NOT_CHECKED, LongRangeResult, long_range_stage
from colmap_av1.poses.mapping_stage import MappedResult, mapping_stage, with_model_first
from colmap_av1.poses.match_stage import MatchesResult, match_stage, read_links
from colmap_av1.poses.parts import certain_stage, split_stage
from colmap_av1.poses.posed_images import PosesResult, read_poses
from colmap_av1.poses.remapping import remap_stage
from colmap_av1.poses.resection_stage import resection_stage
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept

# Number of the adjustment after the first split; 1 and 2 follow the first and second mapping.
_FIRST_SPLIT = 3
# A second mapping of the first model must agree with this share of the observations. On walks with
# turns, correct ones agreed with 88 to 99 %.
_LEAST_KEPT = 0.8


@dataclass(frozen=True)
class Estimate:
    """The finished stages of the joint estimate, and the tracks that agree with its poses.

    Each step takes an estimate and returns one with further stages.

    Attributes:
        matches: the database of the key images, see `match_stage`; that of the first model.
        mapped: the poses of the key images, see `mapping_stage`; after a second mapping or a split,
            those of all its images.
        tracks: the tracks of all videos.
        resection: the poses of the images in between; None if all images are key images.
        dynamic: the dynamic objects; None if they were not looked for.
        adjustment: the adjusted poses; None if they are not adjusted.
        long_range: the long-range check; `NOT_CHECKED` before it, and for further models.
        rival: the adjustment of the first mapping if a second one replaced it, but fits the
            observations hardly better; else None.
    """

    matches: Kept[MatchesResult]
    mapped: Kept[MappedResult]
    tracks: EstimateTracks
    resection: Kept[PosesResult] | None = None
    dynamic: Kept[DynamicResult] | None = None
    adjustment: Kept[AdjustedResult] | None = None
    long_range: Kept[LongRangeResult] = NOT_CHECKED
    rival: Kept[AdjustedResult] | None = None

    @property
    def last(self) -> Kept[PosesResult]:
        """The stage with the final poses."""
        return self.adjustment or self.resection or self.mapped

    @property
    def is_contradicted(self) -> bool:
        """Whether pictures far apart in time contradict the poses."""
        return self.long_range.result.contradicts_poses

    @property
    def is_confirmed(self) -> bool:
        """Whether pictures far apart in time agree with the poses."""
        return self.long_range.result.median is not None and not self.is_contradicted

    @property
    def is_doubtful(self) -> bool:
        """Whether the focal length may be wrong, or the model may bend where links replace motion.

        It may bend if points connect it poorly somewhere, or if its focal length is still assumed.
        """
        if self.adjustment is None:
            return False
        links, adjusted = self.matches.result.links, self.adjustment.result
        is_uncertain = bool(
            adjusted.doubtful_seams
            or adjusted.scale_lost_seams
            or adjusted.keeps_assumed_focal_length
        )
        may_bend = bool(links.gaps or links.fast) and is_uncertain
        return adjusted.has_long_focal_length or may_bend

    @property
    def seams_to_split(self) -> list[tuple[str, str]]:
        """Names of the images before and after each seam to split the model at."""
        if self.adjustment is None:
            return []
        adjusted = self.adjustment.result
        seams = adjusted.doubtful_seams if self.is_contradicted else adjusted.few_point_seams
        return sorted({*seams, *adjusted.scale_lost_seams})

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
class KeyImageModels:
    """The matched images and the mapper's models of them.

    Attributes:
        matches: the database of the key images.
        key_images: these images.
        mapped: the mapper's models.
    """

    matches: Kept[MatchesResult]
    key_images: ImageSet
    mapped: Kept[MappedResult]


def map_key_images(
    run: Run, videos: Sequence[VideoTracks], image_set: ImageSet, *, doubted: Sequence[int]
) -> KeyImageModels:
    """Match and map the key images; `doubted` as in `match_stage`."""
    matches = match_stage(run, videos, image_set, doubted)
    depth = matches.result.depth
    if not depth.is_observable:
        raise ModelError(f"{run.inputs.name}: {depth.warning}")
    key_images = image_set.some(matches.result.key_images)
    mapped = mapping_stage(run, matches, image_set, key_images)
    return KeyImageModels(matches, key_images, mapped)


def pose_images(
    run: Run,
    videos: Sequence[VideoTracks],
    image_set: ImageSet,
    found: KeyImageModels,
    model_file: str | None,
) -> Estimate:
    """Resect and adjust one of the mapper's models, and map it again if it is doubtful.

    Args:
        run: the run.
        videos: the tracks of each video.
        image_set: the images.
        found: the mapper's models.
        model_file: file of the one to continue with; None for the largest.
    """
    mapped = found.mapped
    if model_file is not None:
        mapped = with_model_first(run, mapped, model_file)
    estimate = mapped_poses(
        run,
        found.matches,
        mapped,
        [own.tracks for own in videos],
        image_set,
        # Without a read-out time the tracks were not corrected.
        has_picture_positions=not any(own.read_out for own in videos),
    )
    estimate = refined_poses(run, estimate, image_set, found.key_images)
    if estimate.is_doubtful:
        estimate = remapped_poses(run, estimate, image_set, least_kept=_LEAST_KEPT)
    return _long_range_check(run, estimate, image_set)


def mapped_poses(
    run: Run,
    matched: Kept[MatchesResult],
    mapped: Kept[MappedResult],
    tracks: Sequence[Tracks],
    image_set: ImageSet,
    *,
    has_picture_positions: bool,
) -> Estimate:
    """The poses of a mapper, and the links and the tracks cut at gaps that links replace.

    Args:
        run: the run that was matched.
        matched: the database that was mapped.
        mapped: the poses of the mapper.
        tracks: the tracks of each video.
        image_set: all images.
        has_picture_positions: see `EstimateTracks`.
    """
    links, contradicted = read_links(run.stages)
    every = Tracks.in_sequence(tracks, image_set.num_frames)
    cut = every.split_after_frames(contradicted.tolist())
    return Estimate(matched, mapped, EstimateTracks(cut, links, has_picture_positions))


def refined_poses(run: Run, estimate: Estimate, image_set: ImageSet, keyed: ImageSet) -> Estimate:
    """Estimate the poses of the images between the key images, and adjust all poses.

    Args:
        run: the run.
        estimate: the poses of the mapper, see `mapped_poses`.
        image_set: the images.
        keyed: the key images.
    """
    if len(keyed.sequence) < len(image_set.sequence):
        resection = resection_stage(run, estimate.tracks.motion, image_set, keyed, estimate.mapped)
        estimate = replace(estimate, resection=resection)
    if run.options.moving != "keep":
        dynamic = dynamic_stage(run, estimate.tracks.motion, image_set, estimate.last)
        tracks = without_dynamic(run, estimate.tracks, image_set, dynamic)
        estimate = replace(estimate, dynamic=dynamic, tracks=tracks)
    if not run.options.poses.adjust:
        return estimate
    return _adjusted(run, estimate, image_set, estimate.last)


def _adjusted(
    run: Run, estimate: Estimate, image_set: ImageSet, poses: Kept[PosesResult], *, number: int = 1
) -> Estimate:
    """The estimate with adjusted poses, see `adjustment_stage`."""
    adjustment = adjustment_stage(
        run,
        estimate.tracks,
        image_set,
        poses,
        is_fast=bool(estimate.matches.result.links.fast),
        is_assumed=estimate.matches.result.assumes_video_focal_length and number == 1,
        number=number,
    )
    return replace(estimate, adjustment=adjustment)


def remapped_poses(
    run: Run, estimate: Estimate, image_set: ImageSet, *, least_kept: float
) -> Estimate:
    """Map the images again from the adjusted observations, and use that unless its cost is higher.

    See `remapping`. Nothing is mapped again if the adjustment did not use corners.

    Args:
        run: the run.
        estimate: the adjusted poses.
        image_set: the images.
        least_kept: the second mapping is rejected if a smaller share of the observations agrees
            with it.
    """
    if estimate.adjustment is None or not estimate.tracks.has_picture_positions:
        return estimate
    again = remap_stage(run, image_set, estimate.mapped, estimate.adjustment)
    if not again.result.fits(least_kept):
        return estimate
    rival = None if again.result.is_clearly_better else estimate.adjustment
    estimate = replace(estimate, mapped=again, rival=rival)
    return _adjusted(run, estimate, image_set, again, number=2)


def _long_range_check(
    run: Run, estimate: Estimate, image_set: ImageSet, *, number: int = 1
) -> Estimate:
    """The estimate with a long-range check of its poses; `number` as in `long_range_stage`."""
    check = long_range_stage(
        run,
        estimate.tracks,
        image_set,
        estimate.last,
        searched_loops=estimate.matches.result.links.searched_loops,
        number=number,
    )
    return replace(estimate, long_range=check)


@dataclass(frozen=True)
class SplitModel:
    """A model after it was split.

    Attributes:
        estimate: the poses of its largest part.
        uncertain: result of `certain_stage` if too few images of this part are certain: `estimate`
            then has all of them, and a further model is not used. Else None.
    """

    estimate: Estimate
    uncertain: Kept[MappedResult] | None = None


def split_at_seams(
    run: Run, estimate: Estimate, image_set: ImageSet, *, is_further: bool = False
) -> SplitModel:
    """Split the model at seams with few points, and adjust the largest part separately.

    If pictures far apart in time contradict the poses, it is split at doubtful seams, too. The
    separate adjustment may change the number of points at a seam, so the seams of the largest part
    are checked again until no split is left.

    Images of a model with such seams are also removed if their positions are uncertain, see
    `certain_parts`. Further models, which pictures far apart do not check, are also split where the
    camera leaps against their points, see `misplaced_seams`.

    Args:
        run: the run.
        estimate: the adjusted poses.
        image_set: the images.
        is_further: the model is not the first: leaps are tested, and images with uncertain
            positions are removed even if there are no such seams.
    """
    may_bend = is_further
    whole = estimate.tracks.motion
    for number in count(_FIRST_SPLIT):
        if estimate.adjustment is None:
            break
        num_images = estimate.adjustment.result.num_registered
        seams = estimate.seams_to_split
        leaps = leaping_seams(read_poses(run, estimate.adjustment), image_set) if is_further else []
        may_bend |= bool(seams)
        parts = None
        if seams or leaps:
            parts = split_stage(
                run,
                image_set,
                estimate.mapped,
                estimate.adjustment,
                seams,
                leaps=leaps,
                tracks=estimate.tracks.motion,
                whole=whole,
                rival=estimate.rival,
                number=number,
            )
        if parts is None or parts.result.num_registered == num_images:
            if not may_bend:
                break
            seams, leaps = [], []
            parts = certain_stage(
                run, image_set, estimate.mapped, estimate.adjustment, number=number
            )
            if parts.result.num_registered == num_images:
                break
            if parts.result.num_registered == 0:
                return SplitModel(estimate, uncertain=parts)
        kept = read_poses(run, parts).by_name.keys()
        cut = [*seams, *(leap for leap in leaps if not kept >= {*leap})]
        estimate = _largest_part(run, estimate, image_set, parts, cut, number=number)
    return SplitModel(estimate)


def _largest_part(
    run: Run,
    estimate: Estimate,
    image_set: ImageSet,
    parts: Kept[MappedResult],
    cut: Sequence[tuple[str, str]],
    *,
    number: int,
) -> Estimate:
    """Adjust and check the largest part of a model separately.

    Motion across a seam is not used any more, because it may be wrong there. Links are: without
    them, a part that returns to a place would fall apart.

    Args:
        run: the run.
        estimate: the poses of the model.
        image_set: the images.
        parts: its parts.
        cut: names of the images before and after each seam.
        number: number of the adjustment.
    """
    frame_of = image_set.images.frame_of
    motion = estimate.tracks.motion.split_after_frames([frame_of[first] for first, _ in cut])
    estimate = replace(estimate, mapped=parts, tracks=replace(estimate.tracks, motion=motion))
    estimate = _adjusted(run, estimate, image_set, parts, number=number)
    is_checked = estimate.long_range is not NOT_CHECKED
    return _long_range_check(run, estimate, image_set, number=number) if is_checked else estimate
