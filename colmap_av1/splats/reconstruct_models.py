"""The models that `reconstruct` writes: the largest, and further disconnected models."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.positions import ImagePositions
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.further_models import further_poses
from colmap_av1.poses.placing.stage import PlaceResult, place_stage
from colmap_av1.poses.posed_images import read_posed_images
from colmap_av1.poses.run import Run
from colmap_av1.poses.track_stage import read_tracks_only
from colmap_av1.splats.reconstruct_model import ModelResult, model_stage
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept

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
    run: Run, estimate: Estimate, image_set: ImageSet, positions: ImagePositions
) -> tuple[Kept[PlaceResult], Kept[ModelResult]]:
    """Place the model in the world, and write it with the points of all tracks."""
    placed = place_stage(run, image_set, estimate.last, positions)
    return placed, model_stage(run, estimate.tracks, image_set, placed)


def further_models(
    run: Run, first: Estimate, image_set: ImageSet, positions: ImagePositions
) -> tuple[tuple[FurtherModel, ...], list[str]]:
    """Write the models that are not connected with the first, each in a separate folder.

    Returns:
        The models, and the names of the images that are not registered in any model, in the order
        of frames.
    """
    registered = {image.name for image in read_posed_images(run, first.last, image_set).images}
    found: list[FurtherModel] = []

    def tracks() -> list[Tracks]:
        return [read_tracks_only(run, video) for video in range(len(run.sources))]

    for tried in further_poses(run, first, image_set, tracks, map_again=True):
        own = tried.poses
        if own is None:
            continue
        index = np.searchsorted(image_set.images.frames, own.image_set.images.frames)
        # The known distance is between points of the first model.
        place = replace(own.run.options.place, scale=None)
        placing = replace(own.run, options=replace(own.run.options, place=place))
        _, written = written_model(placing, own.estimate, own.image_set, positions.some(index))
        model = written.result
        images = read_posed_images(own.run, own.estimate.last, own.image_set).images
        names = [image.name for image in images]
        registered.update(names)
        found.append(
            FurtherModel(
                output=own.run.output,
                num_registered=len(names),
                first=names[0],
                last=names[-1],
                num_points=model.num_points,
                mean_error=model.mean_error,
                may_be_bent=_usual_scaled(own.estimate) < _FEW_POINTS * _usual_scaled(first),
            )
        )
    return tuple(found), [name for name in image_set.images.names if name not in registered]


def _usual_scaled(estimate: Estimate) -> float:
    """`usual_scaled` of `AdjustedResult`; 0 for poses that are not adjusted."""
    return estimate.adjustment.result.usual_scaled if estimate.adjustment is not None else 0.0
