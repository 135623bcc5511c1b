"""Known distances in a model, between two cameras or two marked points."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.errors import OptionError
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres
from colmap_av1.options.place import End, KnownDistance
from colmap_av1.util.arrays import Floats

# Smallest angle in degrees between the rays to a marked point. With a smaller angle its depth is
# not observable.
_LEAST_ANGLE = 1.0
# Largest angle in degrees between the ray of a mark and the direction to the triangulated point.
_LARGEST_MISS = 1.0


def model_distance(
    known: KnownDistance, images: Mapping[str, ModelImage], cameras: Mapping[int, pycolmap.Camera]
) -> float:
    """Measure a known distance in units of the model.

    Args:
        known: the distance.
        images: the registered images by name.
        cameras: cameras of the pictures in which points are marked, by id.

    Raises:
        OptionError: an image is not registered, the rays of an end do not meet, or both ends are at
            the same position.
    """
    ends = [_position_of(end, images, cameras) for end in known.ends]
    distance = float(np.linalg.norm(ends[1] - ends[0]))
    centres = camera_centres(np.array([image.cam_from_world for image in images.values()]))
    if distance <= 1e-6 * float(np.abs(centres - centres.mean(axis=0)).max()):
        raise OptionError(
            f"scale '{known}': both ends are at the same position: give two different ends"
        )
    return distance


def _position_of(
    end: End, images: Mapping[str, ModelImage], cameras: Mapping[int, pycolmap.Camera]
) -> Floats:
    """Position [3] of an end: a camera centre, or the triangulated point of its marks."""
    missing = next((mark.image for mark in end.marks if mark.image not in images), None)
    if missing is not None:
        some = ", ".join(sorted(images)[:2])
        raise OptionError(
            f"scale: the model has no image '{missing}': give registered images, such as {some}"
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
    # Least squares of the distances to the rays.
    across = np.eye(3) - rays[:, :, None] * rays[:, None, :]
    cosines = np.clip(rays @ rays.T, -1, 1)
    if np.rad2deg(np.arccos(cosines.min())) < _LEAST_ANGLE:
        raise OptionError(
            f"scale: '{end}' is seen from nearly one direction: mark it in images farther apart"
        )
    position = np.linalg.solve(across.sum(axis=0), np.einsum("nij,nj->i", across, centres))
    towards = position - centres
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    miss = np.rad2deg(np.arccos(np.clip((towards * rays).sum(axis=1), -1, 1)))
    if miss.max() > _LARGEST_MISS:
        worst = end.marks[int(miss.argmax())].image
        raise OptionError(
            f"scale: '{end}' does not mark the same point, {worst} is off by {miss.max():.1f} "
            "degrees: mark one point in all images, in pixels of the model's images"
        )
    return np.asarray(position)


def _ray(camera: pycolmap.Camera, xy: Floats) -> Floats:
    """Unit vector [3] of the ray of a pixel, in camera coordinates."""
    x, y = np.asarray(camera.cam_from_img(xy[None]))[0]
    ray = np.array([x, y, 1.0])
    return np.asarray(ray / np.linalg.norm(ray))
