"""Assign the images of a model to videos."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.errors import ImageError, ModelError
from colmap_av1.images.choosing import check_frame_list
from colmap_av1.images.inputs import Inputs
from colmap_av1.images.masks import VideoMasks
from colmap_av1.images.orientation import ShownImages, shown_images
from colmap_av1.options import ImageOptions
from colmap_av1.video.facts import Video


@dataclass(frozen=True)
class VideoImages:
    """A video, and the model's images of it: names in a folder, how they show it, and masks."""

    video: Video
    names: list[str]
    folder: Path | None
    shown: ShownImages
    masks: VideoMasks | None


def images_of_videos(
    model: Path,
    sizes: Mapping[str, tuple[int, int]],
    inputs: Inputs,
    folder: Path | None,
    options: ImageOptions,
) -> list[VideoImages]:
    """Assign the images of a model, given as (width, height) by name, to the videos.

    Raises:
        ModelError: the model has an image of another video, or none of a video.
        ImageError: images do not fit their video.
    """
    photos = {photo.name for photo in inputs.photos}
    of_label: dict[str, dict[str, tuple[int, int]]] = {label: {} for label in inputs.labels}
    for name in sorted(sizes.keys() - photos):
        label, _, own = name.partition("/") if any(of_label) else ("", "", name)
        if label not in of_label:
            raise ModelError(
                f"{model}: image '{name}' is not in a folder of a video ({', '.join(of_label)}): "
                "give the video it comes from, or the photos as --photos"
            )
        of_label[label][own] = sizes[name]
    found = []
    given = zip(inputs.videos, of_label.items(), inputs.masks_of_videos, strict=True)
    for video, (label, listed), masks in given:
        if not listed:
            raise ModelError(f"{model}: has no image of {video}: leave that video out")
        own_folder = folder / label if folder is not None else None
        images = _images_of_video(model, video, listed, own_folder, options)
        if masks is not None:
            sizes_of_masks = [images.shown.size, images.shown.video_size]
            masks.check(sizes_of_masks, images.names, options)
        found.append(replace(images, masks=masks))
    return found


def _images_of_video(
    model: Path,
    video: Video,
    sizes: Mapping[str, tuple[int, int]],
    folder: Path | None,
    options: ImageOptions,
) -> VideoImages:
    """Check that the model's images of a video fit it."""
    check_frame_list(options)
    if len(sizes) < 2:
        raise ModelError(
            f"{model}: only one image of {video} is registered: give a model with two or more"
        )
    try:
        shown = shown_images(video, sizes, folder)
    except ImageError as error:
        raise ImageError(f"{model}: {error}") from error
    missing = next((n for n in sizes if folder is not None and not (folder / n).is_file()), None)
    if missing is not None:
        raise ImageError(
            f"{folder}: lacks the model's image '{missing}': give the folder of the model's images"
        )
    return VideoImages(video, list(sizes), folder, shown, None)
