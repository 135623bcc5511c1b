"""Images that a database already lists: the video that each belongs to, and their cameras."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path

import pycolmap

from colmap_av1.database.reading import DatabaseImage, read_cameras, read_images
from colmap_av1.database.writing import check_writable
from colmap_av1.errors import DatabaseError, OptionError
from colmap_av1.geometry.cameras import check_pixel_aspect
from colmap_av1.images.inputs import Inputs
from colmap_av1.images.preparing import PreparedInputs
from colmap_av1.matching.cameras import ImageCameras
from colmap_av1.options import CameraOptions, OnExisting


def read_listed_images(
    database: Path, on_existing: OnExisting, camera: CameraOptions
) -> list[DatabaseImage]:
    """Read the images that a database lists, and check that it can be written.

    Args:
        database: path of the database, which need not exist.
        on_existing: what to do if the images have keypoints or matches.
        camera: camera options, which must not be given if there are images.

    Raises:
        DatabaseError: the database cannot be written, or its images have keypoints or matches,
            which `on_existing` does not allow.
        OptionError: the images already have cameras.
    """
    check_writable(database)
    listed = read_images(database)
    filled = next((i for i in listed if i.num_keypoints or i.num_matches), None)
    if filled is not None and on_existing == "error":
        raise DatabaseError(
            f"{database}: image '{filled.name}' already has {filled.num_keypoints} keypoints and "
            f"{filled.num_matches} matches: --on_existing append adds to them, replace removes them"
        )
    if listed:
        _check_no_camera(database, camera)
    return listed


def listed_of_videos(
    database: Path, listed: Sequence[DatabaseImage], inputs: Inputs
) -> list[Mapping[str, tuple[int, int]]]:
    """(width, height) of the images that a database lists, for each video.

    Args:
        database: path of the database, for messages.
        listed: its images.
        inputs: the videos and photos.

    Returns:
        For each video, the sizes by image name relative to the video's folder.

    Raises:
        DatabaseError: the database lists images, but none of a video, or not every photo, or images
            outside the videos' folders, or an image whose camera is missing.
    """
    lone = next((image for image in listed if 0 in {image.width, image.height}), None)
    if lone is not None:
        raise DatabaseError(
            f"{database}: camera {lone.camera_id} of image '{lone.name}' is missing or has no "
            "size: import the image again, or use a new database"
        )
    sizes = {image.name: (image.width, image.height) for image in listed}
    of_videos: list[dict[str, tuple[int, int]]] = [{} for _ in inputs.labels]
    for photo in inputs.photos if listed else ():
        if sizes.pop(photo.name, None) is None:
            raise DatabaseError(
                f"{database}: lists images, but not '{photo.name}': import it too, or use a new "
                "database"
            )
    if listed and not sizes:
        raise DatabaseError(
            f"{database}: lists images, but none of a video: import its images too, or use a new "
            "database"
        )
    if inputs.labels == ("",):
        return [sizes]
    for name, size in sizes.items():
        label, _, own = name.partition("/")
        if label not in inputs.labels:
            raise DatabaseError(
                f"{database}: lists image '{name}', which is not in the folder of a video "
                f"({', '.join(inputs.labels)}): import the images under such names, or use a new "
                "database"
            )
        of_videos[inputs.labels.index(label)][own] = size
    for label, found in zip(inputs.labels, of_videos, strict=True):
        if listed and not found:
            raise DatabaseError(
                f"{database}: lists images, but none in folder '{label}': import that video's "
                "images, or use a new database"
            )
    return [*of_videos]


def listed_cameras(
    database: Path, listed: Sequence[DatabaseImage], names: Sequence[str]
) -> list[pycolmap.Camera]:
    """The cameras that the database holds for its images, one for each name."""
    cameras = read_cameras(database)
    camera_id = {image.name: image.camera_id for image in listed}
    return [cameras[camera_id[name]] for name in names]


def listed_image_cameras(
    database: Path, listed: Sequence[DatabaseImage], prepared: PreparedInputs
) -> ImageCameras:
    """The cameras that the database holds for its images, and warnings about their pixels.

    Args:
        database: the database.
        listed: its images.
        prepared: the same images, prepared for matching.
    """
    image_set, inputs = prepared.image_set, prepared.inputs
    cameras = listed_cameras(database, listed, image_set.images.names)
    warnings = [
        check_pixel_aspect(
            cameras[image_set.images_of(video).start],
            own.shown.pixel_aspect,
            "import the images with one of these",
        )
        for video, own in enumerate(prepared.videos)
    ]
    return ImageCameras(cameras, None, tuple(inputs.with_names(warnings)))


def _check_no_camera(database: Path, options: CameraOptions) -> None:
    """Refuse camera options if the existing images already have cameras.

    Raises:
        OptionError: an option differs from its default.
    """
    default = CameraOptions()
    of_camera = [f.name for f in fields(options) if f.name != "rolling_shutter"]
    changed = [name for name in of_camera if getattr(options, name) != getattr(default, name)]
    if changed:
        raise OptionError(
            f"{database}: its images already have cameras, so {changed[0]} would have no effect: "
            "omit the option, or import the images with that camera"
        )
