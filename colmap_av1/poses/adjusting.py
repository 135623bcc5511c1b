"""Bundle adjustment of a model in memory, on a selection of its observations."""

from __future__ import annotations

import copy
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import (
    ModelPoints,
    keep_observations,
    posed_images,
    read_model,
    take_points,
    write_model,
)
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.options import ReconstructOptions
from colmap_av1.poses.mapper import ADJUSTMENT_STEPS, ADJUSTMENT_TOLERANCE, adjust_model
from colmap_av1.poses.run import Run

# Scales of the robust loss in pixels. Half of the observations have errors below 0.3 to 0.4 px;
# larger ones have drifted. The first adjustment has a larger scale: the mapper may leave images
# whose observations are all far off.
LOSS_SCALES = (1.0, 0.25)
# Mean number of observations per image in the adjustment. Its time grows with their number, and
# more improve the poses little.
OBSERVATIONS = 250
# Smallest number of observations that a point keeps.
_LEAST_KEPT = 8
# Step of the phase with which consecutive points keep observations, the golden ratio: points that
# are observed in the same images then keep different ones.
_PHASE_STEP = (5**0.5 - 1) / 2


def refines_intrinsics(options: ReconstructOptions) -> bool:
    """Whether focal length and distortion are refined; by default if they are not given."""
    if options.mapping.refine_intrinsics is not None:
        return options.mapping.refine_intrinsics
    return options.match.camera.camera_params is None


@dataclass(frozen=True)
class Adjusted:
    """An adjusted model.

    Attributes:
        model: the model.
        points: int64 [num_points] index of each of its points in the model before.
    """

    model: PosedModel
    points: NDArray[np.int64]


def adjust_posed(
    run: Run,
    model: PosedModel,
    *,
    log: str = "adjustment.log",
    loss_scales: Sequence[float] = LOSS_SCALES,
    max_steps: int = ADJUSTMENT_STEPS,
    tolerance: float = ADJUSTMENT_TOLERANCE,
) -> Adjusted:
    """Bundle-adjust a model with the options of the run.

    If there are many observations, the adjustment uses a selection, see `used_observations`.

    Args:
        run: the run.
        model: the model, with points.
        log: name of the file of the stages for COLMAP's output.
        loss_scales: see `adjust_model`, as the following.
        max_steps: largest number of iterations.
        tolerance: function tolerance of the last adjustment.

    Returns:
        The adjusted model with all observations, except those of points behind the camera.
    """
    used = used_observations(model.points, len(model.images), OBSERVATIONS)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        points, _ = keep_observations(model.points, used)  # every point keeps enough
        write_model(folder, model.cameras, model.images, points)
        adjust_model(
            folder,
            refine_intrinsics=refines_intrinsics(run.options),
            loss_scales=loss_scales,
            seed=run.options.match.run.seed,
            num_threads=run.options.mapping.mapper_threads,
            log=run.stages / log,
            max_steps=max_steps,
            tolerance=tolerance,
        )
        found = read_model(folder)
    images = posed_images(found)
    # COLMAP removes points behind their cameras. The ids of points start at 1.
    left = np.array(sorted(found.points3D), np.int64) - 1
    xyz = np.array([found.points3D[i + 1].xyz for i in left.tolist()], np.float64).reshape(-1, 3)
    adjusted = PosedModel(
        {i: copy.copy(found.cameras[i]) for i in model.cameras},
        [images[image.name] for image in model.images],
        replace(take_points(model.points, left), xyz=xyz),
    )
    ahead = np.isfinite(reprojection_errors(adjusted))
    points, kept = keep_observations(adjusted.points, ahead)
    return Adjusted(replace(adjusted, points=points), left[kept])


def used_observations(points: ModelPoints, num_images: int, mean: float) -> NDArray[np.bool_]:
    """Choose observations for the adjustment: a given mean number per image.

    Points with many observations keep as many as each other, evenly spread over their images.
    Points with few keep all, and so do images with few.

    Args:
        points: the points.
        num_images: number of images of the model.
        mean: mean number of observations per image; images with no more keep all.

    Returns:
        bool [num_observations]; all true if there are not more.
    """
    used = np.ones(len(points.image), np.bool_)
    lengths = np.diff(points.offsets)
    wanted = mean * num_images
    if len(used) <= wanted:
        return used
    most = np.arange(1, int(lengths.max()) + 1)
    # Number of observations if each point keeps at most 1, 2, ... of them.
    at_least = np.cumsum(np.bincount(lengths, minlength=len(most) + 1)[:0:-1])[::-1]
    kept = max(_LEAST_KEPT, int(most[np.searchsorted(np.cumsum(at_least), wanted)]))
    point = np.repeat(np.arange(len(lengths)), lengths)
    share = np.minimum(1.0, kept / lengths)[point]
    place = np.arange(len(used)) - points.offsets[point] + _PHASE_STEP * point
    used = np.floor((place + 1) * share) > np.floor(place * share)
    poor = np.bincount(points.image, minlength=num_images) <= mean
    return np.asarray(used | poor[points.image])
