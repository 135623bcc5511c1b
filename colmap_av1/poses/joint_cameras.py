"""The cameras for a database of the joint estimate: adjusted ones where it determines them."""

from __future__ import annotations

import copy
from collections import defaultdict
from collections.abc import Sequence
from collections.abc import Set as AbstractSet

import numpy as np
import pycolmap

from colmap_av1.database.listed import listed_cameras
from colmap_av1.database.reading import read_images
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.adjusting import FOCAL_LENGTH_ERROR, focal_length_errors, refines_intrinsics
from colmap_av1.poses.run import Run

# The adjusted camera of each of some images, by the index of the image.
_CameraOfImage = dict[int, pycolmap.Camera]


def joint_cameras(
    run: Run, image_set: ImageSet, models: Sequence[tuple[PosedModel, AbstractSet[str]]]
) -> list[pycolmap.Camera]:
    """The camera of each image; images share a camera if it is the same object.

    Cameras of an existing database stay unchanged. If the focal length of a video changes, each of
    its images has its own adjusted camera. Otherwise the images of a video have the adjusted camera
    of its largest model, if the focal length was estimated from tracks or the model determines it;
    if not, the assumed one.

    Args:
        run: the run.
        image_set: the images.
        models: the adjusted models with their points, and the names of the images of each, the
            largest first.
    """
    if run.cameras is not None:
        return run.cameras.of_images
    initial = _initial_cameras(run, image_set)
    adjusted = _adjusted_cameras(initial, image_set.images.names, models)
    shared = [adjusted.get(id(camera), {}) for camera in initial]
    assumed = {
        id(next(iter(own.values())))
        for camera, own in zip(initial, shared, strict=True)
        if own and not camera.has_prior_focal_length and not _has_several(own)
    }
    determined = _determined(run, [model for model, _ in models], assumed)
    cameras = []
    for i, (camera, own) in enumerate(zip(initial, shared, strict=True)):
        if _has_several(own):
            index = np.array(list(own))
            nearest = own[int(index[np.argmin(np.abs(index - i))])]
            cameras.append(nearest if i in own else copy.copy(nearest))
            continue
        found = next(iter(own.values()), camera)
        is_known = camera.has_prior_focal_length or id(found) in determined
        cameras.append(found if is_known else camera)
    return cameras


def _initial_cameras(run: Run, image_set: ImageSet) -> list[pycolmap.Camera]:
    """The camera with which each image was mapped; images of a video share it."""
    database = run.output / "database.db"
    listed = read_images(database)
    names = [image.name for image in listed]
    camera_of = dict(zip(names, listed_cameras(database, listed, names), strict=True))
    sequence = image_set.sequence.tolist()
    of_sequence = {
        own: camera_of[name]
        for own, name in zip(sequence, image_set.images.names, strict=True)
        if name in camera_of  # it is a key image
    }
    return [of_sequence[own] for own in sequence]


def _adjusted_cameras(
    initial: Sequence[pycolmap.Camera],
    names: Sequence[str],
    models: Sequence[tuple[PosedModel, AbstractSet[str]]],
) -> dict[int, _CameraOfImage]:
    """The adjusted cameras of the images that share an initial camera, by the id of that object.

    They are those of the first model that has any of these images, or of all models if the focal
    length changes.
    """
    adjusted = dict[int, _CameraOfImage]()
    for model, in_model in models:
        found = defaultdict[int, _CameraOfImage](dict)
        by_name = model.by_name
        for camera in model.cameras.values():
            camera.has_prior_focal_length = True  # COLMAP's model files do not hold it
        for i, name in enumerate(names):
            if name in in_model:
                found[id(initial[i])][i] = model.cameras[by_name[name].camera_id]
        for key, own in found.items():
            if key not in adjusted:
                adjusted[key] = own
            elif _has_several(adjusted[key]) or _has_several(own):
                adjusted[key] |= own
    return adjusted


def _has_several(cameras: _CameraOfImage) -> bool:
    """Whether images that shared a camera have different ones after the adjustment."""
    return len({id(camera) for camera in cameras.values()}) > 1


def _determined(run: Run, models: Sequence[PosedModel], cameras: AbstractSet[int]) -> set[int]:
    """Those of some adjusted cameras, by the id of the object, that their model determines."""
    determined = set[int]()
    if not refines_intrinsics(run.options):
        return determined
    for model in models:
        if any(id(camera) in cameras for camera in model.cameras.values()):
            with run.clock.measure("adjustment"):
                errors = focal_length_errors(model)
            determined |= {
                id(camera)
                for number, camera in model.cameras.items()
                if errors[number] < FOCAL_LENGTH_ERROR
            }
    return determined
