"""The poses of models that are not connected to the first."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.errors import ModelError, writing
from colmap_av1.geometry.posed_model import PosedModel, read_posed_model, write_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.estimate_steps import (
    Estimate,
    mapped_poses,
    refined_poses,
    remapped_poses,
    split_at_seams,
)
from colmap_av1.poses.mapper import LEAST_IMAGES
from colmap_av1.poses.mapping_stage import MappedResult
from colmap_av1.poses.parts import MIN_MODEL_SIZE
from colmap_av1.poses.posed_images import read_poses
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.files import remove_leftovers
from colmap_av1.util.stages import Kept, remove_products, run_stage

# Folders of further models, each followed by its number.
_FOLDER = "model_"
# Few points determine a further model, so its first mapping may be wrong, and its observations too.
# A correct second mapping agrees with as few as this share of them.
_LEAST_KEPT = 0.3
# A model with fewer images than this and than the first keeps the intrinsics of the first. In parts
# of rendered walks with 10 to 17 images, the refined focal length was 0.9 to 2 times the true one;
# in those with 24 images or more, it was 0.99 to 1.02 times, with one exception.
_FEW_IMAGES = 30


@dataclass(frozen=True)
class FurtherPoses:
    """The poses of a further model.

    Attributes:
        run: its run, with a separate output folder.
        estimate: its stages.
        image_set: the images that no earlier model has; some of them are registered.
    """

    run: Run
    estimate: Estimate
    image_set: ImageSet


@dataclass(frozen=True)
class TriedModel:
    """A further model that was estimated.

    Attributes:
        poses: its poses; None if it is not used because too few tracks agree with its poses, its
            positions are uncertain, or it has too few images.
        lost: names of images that the mapper registered in it, and that it has lost; other models
            may have them.
    """

    poses: FurtherPoses | None
    lost: frozenset[str]


def further_poses(
    run: Run,
    first: Estimate,
    image_set: ImageSet,
    read_tracks: Callable[[], Sequence[Tracks]],
    *,
    map_again: bool,
) -> Iterator[TriedModel]:
    """Estimate the poses of the models that are not connected to the first, one after the other.

    The mapper may register an image in several models. It belongs to the first of these only,
    because trainers that search the whole output folder would confuse images and masks of different
    models.

    Args:
        run: the run.
        first: the stages of the first model.
        image_set: all images.
        read_tracks: reads the tracks of each video. They are large, so they are not kept between
            the models.
        map_again: map the models again from their observations, see `remapping`.
    """
    first_model = read_poses(run, first.last)
    free = set(image_set.images.names) - first_model.by_name.keys()
    others = _other_models(run, first.mapped)
    waiting = [_with_cameras_of(first_model, other) for other in others]
    number = 1
    while waiting:
        mapped = waiting.pop(0)
        known = set(mapped.model.by_name)
        if len(known & free) < LEAST_IMAGES:  # nearly all of its images are in an earlier model
            continue
        own = _run_of_model(run, number)
        own_poses = _poses_of_model(own, first, mapped)
        if keeps_intrinsics(mapped.model, first_model):
            own = _with_known_intrinsics(own)
        candidates = free.difference(mapped.excluded, *(other.model.by_name for other in waiting))
        some = _named(image_set, known | candidates)
        try:
            estimate = mapped_poses(
                run,
                first.matches,
                own_poses,
                read_tracks(),
                image_set,
                has_picture_positions=first.tracks.has_picture_positions,
            )
            estimate = refined_poses(own, estimate, some, _named(image_set, known))
            if map_again:
                estimate = remapped_poses(own, estimate, some, least_kept=_LEAST_KEPT)
            split = split_at_seams(own, estimate, some, is_further=True)
        except ModelError:  # too few tracks agree with these poses
            split = None
        used = set[str]()
        if split is not None:
            registered = set(read_poses(own, split.estimate.last).by_name)
            if split.uncertain is None and len(registered & free) >= MIN_MODEL_SIZE:
                used = registered & free
            # If a model is not used, its parts must not grow into it again.
            excluded = frozenset() if used else mapped.excluded | registered | known
            waiting += _other_models(own, split.uncertain or split.estimate.mapped, excluded)
        lost = frozenset((known & free) - used)
        if split is None or not used:
            yield TriedModel(None, lost)
            continue
        number += 1
        yield TriedModel(FurtherPoses(own, split.estimate, _named(image_set, free)), lost)
        free -= used
    _remove_further_models(run, number)


@dataclass(frozen=True)
class _MappedModel:
    """A further model of a mapping or a split.

    Attributes:
        digest: digest of the stage that made it.
        file: its file among the products of that stage.
        model: its poses.
        excluded: names of other images that it must not get.
    """

    digest: str
    file: str
    model: PosedModel
    excluded: frozenset[str] = frozenset()


def _other_models(
    run: Run, mapped: Kept[MappedResult], excluded: frozenset[str] = frozenset()
) -> list[_MappedModel]:
    """The models of a stage except the first, without some images that they do not have."""
    models = {file: read_posed_model(run.stages / file) for file in mapped.result.other_models}
    return [
        _MappedModel(mapped.digest, file, model, excluded.difference(model.by_name))
        for file, model in models.items()
    ]


def _named(image_set: ImageSet, names: AbstractSet[str]) -> ImageSet:
    """The images with the given names."""
    return image_set.some([i for i, name in enumerate(image_set.images.names) if name in names])


def _run_of_model(run: Run, number: int) -> Run:
    """The run of a further model, with a separate output folder."""
    output = run.output / f"{_FOLDER}{number}"
    own = replace(run, output=output, stages=output / run.stages.name)
    with writing(output):
        own.stages.mkdir(parents=True, exist_ok=True)
    for folder in (own.output, own.stages):
        remove_leftovers(folder)
    return own


def keeps_intrinsics(model: PosedModel, first: PosedModel) -> bool:
    """Whether a further model keeps the intrinsics of the first, which are not refined again.

    A few images do not determine a camera well.

    Args:
        model: the further model.
        first: the first model.
    """
    is_small = len(model.images) < min(_FEW_IMAGES, len(first.images))
    return is_small and all(image.camera_id in first.cameras for image in model.images)


def _with_known_intrinsics(run: Run) -> Run:
    """The run, without refinement of intrinsics unless the options require it."""
    pose_options = run.options.poses
    pose_options = replace(pose_options, refine_intrinsics=bool(pose_options.refine_intrinsics))
    return replace(run, options=replace(run.options, poses=pose_options))


def _with_cameras_of(first: PosedModel, mapped: _MappedModel) -> _MappedModel:
    """A model of the mapper, with the cameras of the first model, which are adjusted."""
    cameras = {i: first.cameras.get(i, camera) for i, camera in mapped.model.cameras.items()}
    return replace(mapped, model=PosedModel(cameras, mapped.model.images))


def _poses_of_model(own: Run, first: Estimate, mapped: _MappedModel) -> Kept[MappedResult]:
    """Write the poses of a further model to its stages.

    Args:
        own: the run of the further model, see `_run_of_model`.
        first: the first model.
        mapped: the further model.
    """

    def make(partial: Path) -> MappedResult:
        write_posed_model(partial / "mapped.npz", mapped.model)
        count = len(mapped.model.images)
        return MappedResult("mapped.npz", count, first.mapped.result.mapper, ())

    return run_stage(
        own.stages,
        "poses",
        [mapped.digest, first.last.digest, mapped.file],
        MappedResult,
        products=["mapped.npz"],
        make=make,
    )


def _remove_further_models(run: Run, first: int) -> None:
    """Remove further models of an earlier run whose number is `first` or higher."""
    for folder in run.output.glob(f"{_FOLDER}*"):
        number = folder.name.removeprefix(_FOLDER)
        if number.isdecimal() and int(number) >= first and (folder / run.stages.name).is_dir():
            remove_products(folder, folder / run.stages.name)
