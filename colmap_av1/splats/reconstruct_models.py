"""The models that `reconstruct` writes: the largest, and further disconnected models."""

from __future__ import annotations

from collections.abc import Set as AbstractSet
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.errors import ModelError, cannot_write
from colmap_av1.geometry.posed_model import PosedModel, read_posed_model, write_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.estimate import (
    Posed,
    refined_poses,
    split_at_seams,
    trusted_tracks,
)
from colmap_av1.poses.parts import FEWEST_IMAGES
from colmap_av1.poses.placing.stage import PlaceResult, place_stage
from colmap_av1.poses.pose_stages import MappedResult
from colmap_av1.poses.posed_images import read_posed_images
from colmap_av1.poses.run import Run
from colmap_av1.poses.track_stage import LEAST_IMAGES, read_tracks_only
from colmap_av1.splats.reconstruct_model import ModelResult, model_stage
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.files import remove_leftovers
from colmap_av1.util.stages import Kept, remove_products, run_stage

# Folders of further models, each followed by its number.
_FOLDER = "model_"
# A model may be bent if its seams have less than this share of the first model's points with
# parallax. A bent part of the rendered walks had 9 %, correct parts at least 16 % except one.
_FEW_POINTS = 0.2


@dataclass(frozen=True)
class FurtherModel:
    """A model that is not connected with the largest model.

    Attributes:
        output: its folder, with `images/` and `sparse/0/` like that of the largest model.
        num_registered: number of registered images.
        first: name of the first registered image, in the order of frames.
        last: name of the last registered image.
        num_points: number of 3D points.
        mean_error: mean reprojection error of the points in pixels.
        may_be_bent: far fewer points than in the first model carry the scale from image to image.
    """

    output: Path
    num_registered: int
    first: str
    last: str
    num_points: int
    mean_error: float
    may_be_bent: bool

    def __str__(self) -> str:
        doubt = " (few points have parallax: it may be bent)" if self.may_be_bent else ""
        return (
            f"'{self.output.name}' holds {self.num_registered} from '{self.first}' to "
            f"'{self.last}'{doubt}"
        )


def written_model(
    run: Run, posed: Posed, image_set: ImageSet
) -> tuple[Kept[PlaceResult], Kept[ModelResult]]:
    """Place the model in the world, and write it with the points of all tracks."""
    assert run.positions is not None
    placed = place_stage(run, image_set, posed.last, run.positions)
    tracks = Tracks.concatenate(posed.tracks, posed.links)
    return placed, model_stage(run, tracks, image_set, posed.moving, placed)


def further_models(
    run: Run, first: Posed, image_set: ImageSet
) -> tuple[tuple[FurtherModel, ...], list[str]]:
    """Write the models that are not connected with the first, each in a separate folder.

    The mapper may register an image in several models. It is written for the first of these only,
    because trainers that search the whole output folder would confuse images and masks of different
    models.

    Returns:
        The models, and the names of the images that are not registered in any model, in the order
        of frames.
    """
    placed = read_posed_images(run, first.last, image_set).images
    left = set(image_set.images.names) - {image.name for image in placed}
    keyed = image_set.some(first.matches.result.key_images)
    found: list[FurtherModel] = []
    waiting = _other_models(run, first)
    while waiting:
        mapped = waiting.pop(0)
        known = set(mapped.model.by_name)
        if len(known & left) < LEAST_IMAGES:  # The mapper registered these images twice.
            continue
        own = _run_of_model(run, len(found) + 1)
        own_poses = _poses_of_model(run, own, first, mapped)
        free = left.difference(*(other.model.by_name for other in waiting))
        some, key = _named(image_set, known | free), _named(keyed, known)
        tracks = [read_tracks_only(run, video) for video in range(len(run.sources))]
        trusted = trusted_tracks(run, tracks, image_set)
        try:
            posed = refined_poses(
                own,
                first.matches,
                own_poses,
                trusted=trusted,
                image_set=some,
                keyed=key,
                has_picture_positions=first.has_picture_positions,
            )
            posed = split_at_seams(own, posed, some)
        except ModelError:  # no track agrees with the mapper's poses of these images
            continue
        waiting += _other_models(own, posed)
        new = _named(image_set, left)
        images = [image.name for image in read_posed_images(own, posed.last, new).images]
        if len(images) < FEWEST_IMAGES:
            continue
        left -= set(images)
        model = written_model(own, posed, new)[1].result
        found.append(
            FurtherModel(
                output=own.output,
                num_registered=len(images),
                first=images[0],
                last=images[-1],
                num_points=model.num_points,
                mean_error=model.mean_error,
                may_be_bent=_usual_scaled(posed) < _FEW_POINTS * _usual_scaled(first),
            )
        )
    _remove_further_models(run, len(found) + 1)
    return tuple(found), [name for name in image_set.images.names if name in left]


@dataclass(frozen=True)
class _MappedModel:
    """A further model of a mapping or a split.

    Attributes:
        digest: digest of the stage that made it.
        file: its file among the products of that stage.
        model: its poses.
    """

    digest: str
    file: str
    model: PosedModel


def _other_models(run: Run, posed: Posed) -> list[_MappedModel]:
    return [
        _MappedModel(posed.mapped.digest, file, read_posed_model(run.stages / file))
        for file in posed.mapped.result.other_models
    ]


def _usual_scaled(posed: Posed) -> float:
    """`usual_scaled` of `AdjustedResult`; 0 for poses that are not adjusted."""
    return posed.adjustment.result.usual_scaled if posed.adjustment is not None else 0.0


def _named(image_set: ImageSet, names: AbstractSet[str]) -> ImageSet:
    """The images with the given names."""
    return image_set.some([i for i, name in enumerate(image_set.images.names) if name in names])


def _run_of_model(run: Run, number: int) -> Run:
    """The run of a further model, with a separate output folder."""
    output = run.output / f"{_FOLDER}{number}"
    own = replace(run, output=output, stages=output / run.stages.name)
    try:
        own.stages.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ModelError(cannot_write(output, error)) from error
    for folder in (own.output, own.stages):
        remove_leftovers(folder)
    return own


def _poses_of_model(run: Run, own: Run, first: Posed, mapped: _MappedModel) -> Kept[MappedResult]:
    """Write the poses of a further model to its stages.

    A few images do not determine a camera well, so that cameras of the first model are used if it
    has them.

    Args:
        run: the run of the first model.
        own: the run of the further model, see `_run_of_model`.
        first: the first model.
        mapped: the further model.
    """

    def make(partial: Path) -> MappedResult:
        known = read_posed_model(run.stages / first.last.result.poses).cameras
        model = mapped.model
        cameras = {i: known.get(i, camera) for i, camera in model.cameras.items()}
        write_posed_model(partial / "mapped.npz", PosedModel(cameras, model.images))
        return MappedResult("mapped.npz", len(model.images), {}, first.mapped.result.mapper, ())

    return run_stage(
        own.stages,
        "poses",
        [mapped.digest, first.last.digest, mapped.file],
        MappedResult,
        into=own.stages,
        products=["mapped.npz"],
        make=make,
    )


def _remove_further_models(run: Run, first: int) -> None:
    """Remove further models of an earlier run whose number is `first` or higher."""
    for folder in run.output.glob(f"{_FOLDER}*"):
        number = folder.name.removeprefix(_FOLDER)
        if number.isdecimal() and int(number) >= first and (folder / run.stages.name).is_dir():
            remove_products(folder, folder / run.stages.name)
