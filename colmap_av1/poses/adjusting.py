"""Bundle adjustment of a model on a selection of its observations."""

from __future__ import annotations

import copy
import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from colmap_av1.geometry.cameras import has_implausible_intrinsics
from colmap_av1.geometry.colmap_model import ModelImage, posed_images, read_model, write_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.options import ReconstructOptions
from colmap_av1.poses.mapper import ADJUSTMENT_STEPS, ADJUSTMENT_TOLERANCE, adjust_model
from colmap_av1.poses.run import Run
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.colmap_log import only_errors
from colmap_av1.util.spread import evenly_spread

# Scales of the robust loss in pixels. Half of the observations have errors below 0.3 to 0.4 px;
# larger ones have drifted. The first adjustment has a larger scale: the mapper may leave images
# whose observations are all far off.
LOSS_SCALES = (1.0, 0.25)
# Mean number of observations per image in the adjustment. Of 640 observations per image of a video
# of 300 images, 400 take two thirds of the time, and camera centres are off by 0.19 mm instead of
# 0.16 mm on a path of 5 m. With 250, walks in which few points carry the scale across a turn lose
# more of it.
OBSERVATIONS = 400
# Points with more observations keep at least this many.
_FEWEST_KEPT = 8
# The covariance of intrinsics is estimated from at most this number of images and about this number
# of observations of each, whose standard deviation in pixels is assumed.
_COVARIANCE_IMAGES, _COVARIANCE_OBSERVATIONS, _OBSERVATION_ERROR = 200, 100, 0.25
# A focal length is determined if its relative standard deviation is below this. On walks with turns
# the standard deviation is 0.5 % and the true error 0.1 to 0.3 %; on a straight drive they are 1.3
# to 5 % and 1 to 2 %; in clips of seven or eight frames, where the focal length diverges, 36 to
# 45 %. With the adjusted focal length, COLMAP's mapper registers all images of the drive; with the
# assumed one, 5 of 51.
FOCAL_LENGTH_ERROR = 0.1
# An image must observe this many points to stay registered, as COLMAP's mapper requires, or this
# share of the median if that is less. An image filled by a pillar observed 8 where others observed
# 300 or more, and its pose error was 300 times theirs.
_LEAST_OBSERVED, _LEAST_OBSERVED_SHARE = 30, 0.1
# Step of the phase in which consecutive points keep observations: the fractional part of the golden
# ratio. Points that are observed in the same images then keep different ones.
_PHASE_STEP = (5**0.5 - 1) / 2


def refines_intrinsics(options: ReconstructOptions) -> bool:
    """Whether focal length and distortion are refined; by default if they are not given."""
    if options.poses.refine_intrinsics is not None:
        return options.poses.refine_intrinsics
    return options.match.camera.camera_params is None


@dataclass(frozen=True)
class Adjusted:
    """An adjusted model.

    Attributes:
        model: the model.
        kept_points: int64 [num_points] index of each of its points in the model before.
    """

    model: PosedModel
    kept_points: Ints


def have_diverged(cameras: Mapping[int, pycolmap.Camera], images: Sequence[ModelImage]) -> bool:
    """Whether most images have a camera whose intrinsics are implausible."""
    diverged = [has_implausible_intrinsics(cameras[image.camera_id]) for image in images]
    return sum(diverged) > len(diverged) / 2


def adjust_posed(
    run: Run,
    model: PosedModel,
    *,
    log: str = "adjustment.log",
    loss_scales: Sequence[float] = LOSS_SCALES,
    max_steps: int = ADJUSTMENT_STEPS,
    tolerance: float = ADJUSTMENT_TOLERANCE,
    iterative: bool = False,
) -> Adjusted:
    """Bundle-adjust a model with the options of the run, see `adjust_model`.

    If there are many observations, the adjustment uses a selection, see `used_observations`. If
    the intrinsics of most images diverge, because the images do not determine them, those of
    `model` are kept.

    Args:
        run: the run.
        model: the model, with points.
        log: name of COLMAP's log in the folder of the stages.
        loss_scales: see `adjust_model`.
        max_steps: see `adjust_model`.
        tolerance: see `adjust_model`.
        iterative: see `adjust_model`.

    Returns:
        The adjusted model, without observations behind their camera and without points that are
        left with fewer than two.

    Raises:
        ModelError: the adjustment failed.
    """
    used = used_observations(model.points, len(model.images), OBSERVATIONS)
    points, chosen = model.points.keep_observations(used)

    def adjust(*, refine_intrinsics: bool) -> pycolmap.Reconstruction:
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            write_model(folder, model.cameras, model.images, points)
            adjust_model(
                folder,
                refine_intrinsics=refine_intrinsics,
                loss_scales=loss_scales,
                seed=run.context.seed,
                num_threads=run.options.poses.mapper_threads,
                log=run.stages / log,
                max_steps=max_steps,
                tolerance=tolerance,
                iterative=iterative,
            )
            return read_model(folder)

    found = adjust(refine_intrinsics=refines_intrinsics(run.options))
    was_plausible = not have_diverged(model.cameras, model.images)
    if was_plausible and have_diverged(dict(found.cameras), model.images):
        found = adjust(refine_intrinsics=False)
    images = posed_images(found)
    # COLMAP drops observations behind their camera, and then points with fewer than two. The ids
    # of points start at 1.
    ids = sorted(found.points3D)
    left = chosen[np.array(ids, np.int64) - 1]
    xyz = np.array([found.points3D[i].xyz for i in ids], np.float64).reshape(-1, 3)
    unknown = np.full(len(left), -1.0)
    adjusted = PosedModel(
        {i: copy.copy(found.cameras[i]) for i in model.cameras},
        [images[image.name] for image in model.images],
        replace(model.points.take(left), xyz=xyz, error=unknown),
    )
    ahead = np.isfinite(reprojection_errors(adjusted))
    points, enough = adjusted.points.keep_observations(ahead)
    return Adjusted(replace(adjusted, points=points), left[enough])


def without_sparse_images(model: PosedModel) -> Adjusted:
    """Drop the images that observe too few points, and points that are left with fewer than two."""
    counts = np.bincount(model.points.image, minlength=len(model.images))
    least = min(_LEAST_OBSERVED, _LEAST_OBSERVED_SHARE * float(np.median(counts)))
    return Adjusted(*model.some(counts >= least))


def mean_cost(errors: Floats) -> float:
    """Mean Cauchy loss of errors in pixels, divided by the square of its scale."""
    return float(np.log1p((errors / LOSS_SCALES[-1]) ** 2).mean())


def focal_length_errors(model: PosedModel) -> dict[int, float]:
    """Estimate the relative standard deviation of each camera's focal length.

    It is computed from the covariance of all parameters of a bundle adjustment. Errors of
    observations are assumed independent, so the true error may be several times as large.

    Args:
        model: an adjusted model, with points. If it is large, some of its images and observations
            are used.

    Returns:
        The relative standard deviation by camera id; infinite if the focal length is not
        determined.
    """
    num_images = len(model.images)
    spread = evenly_spread(num_images, _COVARIANCE_IMAGES)
    _, first = np.unique([image.camera_id for image in model.images], return_index=True)
    some = np.union1d(spread, first)  # each camera has an image
    part, _ = model.some(np.isin(np.arange(num_images), some))
    used = used_observations(part.points, len(some), _COVARIANCE_OBSERVATIONS)
    points, _ = part.points.keep_observations(used)
    with tempfile.TemporaryDirectory() as folder:
        write_model(Path(folder), part.cameras, part.images, points)
        found = read_model(Path(folder))
    config = pycolmap.BundleAdjustmentConfig()
    for image in found.reg_image_ids():
        config.add_image(image)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = LOSS_SCALES[-1]
    adjuster = pycolmap.create_default_ceres_bundle_adjuster(options, config, found)
    with only_errors():  # COLMAP warns if the covariance cannot be computed
        covariance = pycolmap.estimate_ba_covariance(
            pycolmap.BACovarianceOptions(), found, adjuster
        )
    errors = dict.fromkeys(model.cameras, math.inf)
    for number, camera in found.cameras.items():
        own = covariance.get_other_params_cov(camera.params) if covariance is not None else None
        if own is not None:
            at = camera.focal_length_idxs()[0]
            errors[number] = _OBSERVATION_ERROR * math.sqrt(own[at, at]) / camera.params[at]
    return errors


def used_observations(points: ModelPoints, num_images: int, mean: float) -> Bools:
    """Choose about `mean` observations per image for the adjustment.

    Points with many observations each keep the same number, evenly spread over their images. Points
    with few keep all, and so do images with at most `mean`; more may therefore be left.

    Args:
        points: the points.
        num_images: number of images of the model.
        mean: mean number of observations per image.

    Returns:
        bool [num_observations], true for those to use.
    """
    lengths = np.diff(points.offsets)
    wanted = mean * num_images
    if len(points.image) <= wanted:
        return np.ones(len(points.image), np.bool_)
    # Number of observations if each point keeps at most 1, 2, ... of them.
    at_least = np.cumsum(np.bincount(lengths)[:0:-1])[::-1]
    most = max(_FEWEST_KEPT, 1 + int(np.searchsorted(np.cumsum(at_least), wanted)))
    point = points.point
    share = np.minimum(1.0, most / lengths)[point]
    rank = np.arange(len(point)) - points.offsets[point]
    phase = (0.5 + _PHASE_STEP * point) % 1.0
    used = np.floor((rank + 1) * share + phase) > np.floor(rank * share + phase)
    poor = np.bincount(points.image, minlength=num_images) <= mean
    return np.asarray(used | poor[points.image])
