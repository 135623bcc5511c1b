"""Separate cameras for the images of a video whose focal length changes.

A shared camera hides a zoom: poses and points bend until they fit nearly as well. Groups of a few
consecutive images therefore get a trial camera each. If these differ and lower the cost, the lens
has zoomed, and each image gets its own camera.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Collection, Container
from dataclasses import replace

import numpy as np  # before pycolmap: the other order breaks writing PNG files later

from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors
from colmap_av1.poses.adjusting import (
    LOSS_SCALES,
    Adjusted,
    adjust_posed,
    mean_cost,
    refines_intrinsics,
)
from colmap_av1.poses.run import Run
from colmap_av1.util.arrays import Bools

# Number of images that share a trial camera; fewer determine its focal length less well.
_GROUP = 5
# A lens zooms if the ratio of the longest to the shortest focal length of trial cameras exceeds the
# first value, and the mean cost of an observation falls by more than the second, as a share. Videos
# without a zoom had up to 1.017 and 2.7 %; a zoom by 1.1 has 1.053 and 5.4 %. A zoom by 1.05 is
# missed, but bends the path by only 0.07 %.
_MIN_RANGE = 1.03
_MIN_GAIN = 0.04
_TRIAL_TOLERANCE = 1e-3  # see `adjust_model`
# Poses that a shared camera has bent need many iterations to converge.
_MAX_STEPS = 60
_LOG = "zoom.log"


def with_own_cameras(run: Run, model: PosedModel) -> Adjusted:
    """Adjust a model with a camera for each image, if the options or a zoom require it.

    Args:
        run: inputs and options of the run.
        model: the adjusted model, with points.

    Returns:
        The adjusted model, or the given one.
    """
    single_camera = run.options.match.camera.single_camera
    refines = refines_intrinsics(run.options)
    shared: Collection[int] = ()
    if single_camera is False:
        shared = model.cameras
    elif single_camera is None and refines:
        shared = _zooming_cameras(run, model)
    if not shared:
        return Adjusted(model, np.arange(len(model.points.xyz)))
    existing = run.cameras.of_images if run.cameras is not None else []
    num_cameras = len(run.inputs.videos) + len(run.inputs.photos)
    last = max(num_cameras, *model.cameras, *(camera.camera_id for camera in existing))
    own = _with_copies(model, shared, 1, last)
    if own.cameras.keys() == model.cameras.keys() or not refines:
        return Adjusted(own, np.arange(len(own.points.xyz)))
    for number in own.cameras.keys() - model.cameras.keys():
        # The distortion of the shared camera was fitted to the zoom.
        camera = own.cameras[number]
        params = np.array(camera.params)
        params[list(camera.extra_params_idxs())] = 0.0
        camera.params = params.tolist()
    return adjust_posed(run, own, log=_LOG, max_steps=_MAX_STEPS)


def _zooming_cameras(run: Run, model: PosedModel) -> set[int]:
    """Ids of the cameras whose focal length varies between images."""
    trial = _with_copies(model, model.cameras, _GROUP, max(model.cameras))
    if trial.cameras.keys() == model.cameras.keys():
        return set()
    trial = adjust_posed(
        run,
        trial,
        log=_LOG,
        loss_scales=LOSS_SCALES[-1:],
        max_steps=_MAX_STEPS,
        tolerance=_TRIAL_TOLERANCE,
    ).model
    focal = np.array([trial.cameras[image.camera_id].mean_focal_length() for image in trial.images])
    camera_of_image = np.array([image.camera_id for image in model.images])
    zooming = set()
    for number in np.unique(camera_of_image).tolist():
        is_own = camera_of_image == number
        own = focal[is_own]
        before, after = (_mean_cost(m, is_own) for m in (model, trial))
        gain = 1 - after / before
        if own.max() > _MIN_RANGE * own.min() and gain > _MIN_GAIN:
            zooming.add(number)
    return zooming


def _mean_cost(model: PosedModel, is_own: Bools) -> float:
    """Mean cost of the observations in some images.

    Points behind the camera do not count: COLMAP drops them during the adjustment.
    """
    errors = reprojection_errors(model)[is_own[model.points.image]]
    return mean_cost(errors[np.isfinite(errors)])


def _with_copies(
    model: PosedModel, shared: Container[int], num_images: int, last: int
) -> PosedModel:
    """Replace cameras of a model by several copies.

    Args:
        model: the model.
        shared: ids of the cameras to replace; those that would get a single copy stay.
        num_images: number of consecutive images that share a copy; the last copy may have up to
            twice as many.
        last: the copies get higher ids than this. It is not exceeded by the ids of cameras of other
            models, which would otherwise be confused with the copies.
    """
    count = Counter(image.camera_id for image in model.images)
    rank = dict.fromkeys(count, 0)
    cameras, images = dict(model.cameras), []
    copies: dict[tuple[int, int], int] = {}
    for image in model.images:
        number = image.camera_id
        num_copies = count[number] // num_images if number in shared else 1
        if num_copies > 1:
            part = number, min(rank[number] // num_images, num_copies - 1)
            if part not in copies:
                copies[part] = last + len(copies) + 1
                cameras[copies[part]] = copy.copy(model.cameras[number])
                cameras[copies[part]].camera_id = copies[part]
            rank[number] += 1
            number = copies[part]
        images.append(replace(image, camera_id=number))
    used = {image.camera_id for image in images}
    return replace(model, cameras={i: cameras[i] for i in sorted(used)}, images=images)
