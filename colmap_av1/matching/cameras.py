"""Create the cameras of new images from given intrinsics, tracks and metadata."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap

from colmap_av1.geometry.cameras import (
    check_pixel_aspect,
    is_fisheye,
    is_nearly_pinhole,
    make_camera,
    off_centre_warning,
)
from colmap_av1.images.image_set import ImageSet, ShownVideo
from colmap_av1.images.inputs import notes_of_videos
from colmap_av1.images.photos import Photo
from colmap_av1.matching.focal import estimate_focal_length
from colmap_av1.matching.matched_images import PairedImages
from colmap_av1.options import CameraOptions
from colmap_av1.util.grouping import indices_in
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.metadata.lens import container_focal_length

# Focal lengths from tracks and from the container agree if they differ by less than this factor.
_MAX_FACTOR = 1.2


@dataclass(frozen=True)
class ImageCameras:
    """Cameras of images.

    Attributes:
        of_images: the camera of each image; images that share a camera hold the same object.
        focal_length: estimated focal length of the first video, in pixel heights; None if it was
            not estimated.
        warnings: warnings about the cameras.
    """

    of_images: list[pycolmap.Camera]
    focal_length: float | None
    warnings: tuple[str, ...]


def new_cameras(
    paired: PairedImages,
    image_set: ImageSet,
    shown: Sequence[ShownVideo],
    photos: Sequence[Photo],
    options: CameraOptions,
    *,
    context: RunContext,
) -> ImageCameras:
    """Create a camera for each video, and one for the photos of each physical camera and size.

    Given intrinsics apply to videos, and to photos only if these share the camera. Without given
    intrinsics, the focal length of a video is estimated from its tracks or read from its container.
    Photos take their focal length from EXIF.

    Args:
        paired: the images.
        image_set: maps each image to its video or photo.
        shown: the videos.
        photos: the photos.
        options: camera model, given intrinsics and sharing.
        context: its clock gets the stage "focal length".

    Raises:
        OptionError: given parameters do not fit the pixels.
    """
    of_images: dict[int, pycolmap.Camera] = {}
    estimated: list[float | None] = []
    notes: list[list[str]] = [[] for _ in shown]
    for shared in _sequences_by_camera(len(shown), photos, options):
        given, aspect = options, 1.0
        if shared[0] < len(shown):
            first = shown[shared[0]]
            size, aspect = first.size, first.pixel_aspect
            of_videos = [i for t in shared if t < len(shown) for i in image_set.images_of(t)]
            own = _some_images(paired, of_videos)
            focal_length = shared_focal_length(own, size, aspect, options, context)
            estimated.append(focal_length)
            if given.camera_params is None:
                stated = container_focal_length(first.video.tags, size, aspect)
                focal_length, words = _initial_focal_length(
                    focal_length, stated, given.camera_model
                )
                notes[shared[0]] += words
        else:
            photo = photos[shared[0] - len(shown)]
            size, focal_length = photo.size, photo.focal_length
            given = replace(given, camera_params=None)
        camera = make_camera(given, *size, aspect, focal_length)
        if shared[0] < len(shown):
            notes[shared[0]] += check_pixel_aspect(
                camera, aspect, "leave out --camera_model or give one"
            )
            off_centre = off_centre_warning(camera) if given.camera_params is not None else None
            if off_centre is not None:
                notes[shared[0]].append(off_centre)
        for image in (image for sequence in shared for image in image_set.images_of(sequence)):
            of_images[image] = copy.copy(camera) if given.single_camera is False else camera
    in_order = [of_images[image] for image in range(len(image_set.sequence))]
    warnings = notes_of_videos([own.video for own in shown], notes)
    return ImageCameras(in_order, estimated[0], tuple(warnings))


def shared_focal_length(
    paired: PairedImages,
    size: tuple[int, int],
    pixel_aspect: float,
    options: CameraOptions,
    context: RunContext,
) -> float | None:
    """Estimate the focal length of a camera with unknown intrinsics from tracks.

    Args:
        paired: the images, all of one camera.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        options: camera model and given intrinsics.
        context: its clock gets the stage "focal length".

    Returns:
        The focal length in pixel heights; None if parameters are given or the focal length is not
        observable.
    """
    fisheye = is_fisheye(options.camera_model)
    if options.camera_params is not None:
        return None
    if not (fisheye or is_nearly_pinhole(options.camera_model)):
        return None
    with context.clock.measure("focal length"):
        return estimate_focal_length(
            paired.keypoints,
            paired.pairs,
            paired.matches,
            size,
            pixel_aspect=pixel_aspect,
            fisheye=fisheye,
            seed=context.seed,
        )


def _some_images(paired: PairedImages, images: Sequence[int]) -> PairedImages:
    """Select images, given in ascending order, and the pairs among them."""
    if len(images) == len(paired.keypoints):
        return paired
    pairs = indices_in(np.array(images), len(paired.keypoints))[paired.pairs]
    kept = np.flatnonzero((pairs >= 0).all(axis=1))
    return PairedImages(
        [paired.keypoints[i] for i in images], pairs[kept], [paired.matches[k] for k in kept]
    )


def _initial_focal_length(
    estimated: float | None, stated: float | None, model: str | None
) -> tuple[float | None, list[str]]:
    """Choose the initial focal length of a camera; also return warnings about it.

    The estimate from tracks is preferred: the container states the focal length of the lens, and
    stabilization may have cropped the pictures since.
    """
    if stated is None or not is_nearly_pinhole(model):
        return estimated, []
    if estimated is None:
        return stated, [
            "the focal length is not observable from the motion: the initial value is "
            f"{stated:.0f} px, from the container"
        ]
    if abs(math.log(estimated / stated)) <= math.log(_MAX_FACTOR):
        return estimated, []
    return estimated, [
        f"the focal length is {estimated:.0f} px from the tracks, but {stated:.0f} px from the "
        "container: the first is used, because the container does not account for cropping"
    ]


def _sequences_by_camera(
    num_videos: int, photos: Sequence[Photo], options: CameraOptions
) -> list[list[int]]:
    """Group the videos and photos by camera."""
    if options.single_camera:
        return [list(range(num_videos + len(photos)))]
    of_photos: dict[object, list[int]] = {}
    for sequence, photo in enumerate(photos, start=num_videos):
        of_photos.setdefault((photo.size, photo.camera, photo.focal_length), []).append(sequence)
    return [*([video] for video in range(num_videos)), *of_photos.values()]
