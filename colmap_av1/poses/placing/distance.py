"""A known distance in a model: between two cameras, or two marks in pictures."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import OptionError
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.options.place import End, KnownDistance

_Floats = NDArray[np.float64]

# Angle between the rays to a mark, in degrees, below which its depth is anyone's guess.
_LEAST_ANGLE = 1.0
# Distance in degrees of the rays to a mark from where they meet, beyond which one is elsewhere.
_LARGEST_MISS = 1.0


def model_distance(
    known: KnownDistance, images: Mapping[str, ModelImage], cameras: Mapping[int, object]
) -> float:
    """The known distance in units of the model.

    Args:
        known: which distance.
        images: the images that have a pose, by name.
        cameras: pycolmap.Cameras of the pictures that marks were seen in, by id.

    Raises:
        OptionError: an image has no pose, the rays to a mark do not meet, or both ends are one.
    """
    ends = [_place_of(end, images, cameras) for end in known.ends]
    distance = float(np.linalg.norm(ends[1] - ends[0]))
    centres = camera_centres(np.array([image.cam_from_world for image in images.values()]))
    if distance <= 1e-6 * float(np.abs(centres - centres.mean(axis=0)).max()):
        raise OptionError(f"scale '{known}': both ends are one place: give two that are apart")
    return distance


def _place_of(end: End, images: Mapping[str, ModelImage], cameras: Mapping[int, object]) -> _Floats:
    missing = next((mark.image for mark in end.marks if mark.image not in images), None)
    if missing is not None:
        some = ", ".join(sorted(images)[:2])
        raise OptionError(
            f"scale: the model has no image '{missing}' with a pose: give one it has, such as "
            f"{some}"
        )
    own = [images[mark.image] for mark in end.marks]
    centres = camera_centres(np.array([image.cam_from_world for image in own]))
    if end.marks[0].xy is None:
        return np.asarray(centres[0])
    rays = np.array(
        [
            _ray(cameras[image.camera_id], np.array(mark.xy)) @ image.cam_from_world[:, :3]
            for mark, image in zip(end.marks, own, strict=True)
        ]
    )
    # The place nearest to all rays.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    cosines = np.clip(rays @ rays.T, -1, 1)
    if np.rad2deg(np.arccos(cosines.min())) < _LEAST_ANGLE:
        raise OptionError(
            f"scale: the images see '{end}' from nearly one place: mark it in images further apart"
        )
    place = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    towards = place - centres
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    miss = np.rad2deg(np.arccos(np.clip((towards * rays).sum(axis=1), -1, 1)))
    if miss.max() > _LARGEST_MISS:
        worst = end.marks[int(miss.argmax())].image
        raise OptionError(
            f"scale: '{end}' marks no one place, {worst} sees it {miss.max():.1f} degrees beside: "
            "mark the same in each image, in pixels of the model's images"
        )
    return np.asarray(place)


def _ray(camera: object, xy: _Floats) -> _Floats:
    """Unit vector [3] of a pixel in the camera."""
    x, y = np.asarray(camera.cam_from_img(xy[None]))[0]  # type: ignore[attr-defined]
    ray = np.array([x, y, 1.0])
    return np.asarray(ray / np.linalg.norm(ray))
