"""How existing images show the pictures of a video: rotated as players do, or as stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from colmap_av1.images.files import has_shape, size_of_images
from colmap_av1.images.recognising import is_turned_back
from colmap_av1.video.decoding import decode_frames
from colmap_av1.video.display import UPRIGHT, Display, shown_size, turned_back
from colmap_av1.video.facts import Video


@dataclass(frozen=True)
class ShownImages:
    """How images show the pictures of a video.

    Attributes:
        display: how the images show the video's pictures.
        video_size: (width, height) of the pictures with this display.
        size: (width, height) of the images, which may be scaled.
    """

    display: Display
    video_size: tuple[int, int]
    size: tuple[int, int]

    @property
    def pixel_aspect(self) -> float:
        """Width of the images' pixels over their height."""
        (width, height), (image_width, image_height) = self.video_size, self.size
        # Images may be scaled by different factors along x and y.
        return self.display.pixel_aspect * (width * image_height / (height * image_width))


def shown_images(
    video: Video, existing: Mapping[str, tuple[int, int]], folder: Path | None
) -> ShownImages:
    """Find how existing images show the pictures of a video.

    Args:
        video: the video.
        existing: (width, height) of each image, by name; empty if there are none.
        folder: folder of the images; None: unknown.

    Raises:
        ImageError: the images do not fit the video.
    """
    display, video_size = video.display, video.picture_size
    back = _way_back(video, existing, folder)
    if back is not None:
        # The images were written by a program that does not rotate pictures.
        display = replace(display, turn=UPRIGHT, pixel_aspect=back.pixel_aspect)
        video_size = shown_size(video_size, back)
    size = size_of_images(existing, video_size, display.pixel_aspect)
    return ShownImages(display, video_size, size)


def _way_back(
    video: Video, existing: Mapping[str, tuple[int, int]], folder: Path | None
) -> Display | None:
    """The rotation from shown pictures to existing images; None if they have the same orientation.

    It follows from the shape of the images. If both orientations fit, the content of the first
    image whose file exists decides. Otherwise images are assumed to be rotated as players and
    FFmpeg show them.
    """
    display = video.display
    if display.turn == UPRIGHT or not existing:
        return None
    back = turned_back(display)
    size = next(iter(existing.values()))
    as_shown = has_shape(size, video.picture_size)
    as_stored = has_shape(size, shown_size(video.picture_size, back))
    files = (folder / name for name in existing) if folder is not None else ()
    file = next((file for file in files if file.exists()), None)
    if as_shown and as_stored and file is not None:
        return back if is_turned_back(file, decode_frames(video), display) else None
    return back if as_stored and not as_shown else None
