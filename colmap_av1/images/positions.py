"""Positions of images, from the containers of videos and the EXIF data of photos."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from colmap_av1.images.image_set import ImageSet
from colmap_av1.images.photos import Photo
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.video.facts import Video, picture_times
from colmap_av1.video.metadata.places import are_places
from colmap_av1.video.metadata.positions import Positions, interpolate, read_positions


@dataclass(frozen=True)
class ImagePositions:
    """Positions of images, and the orientation of the camera.

    Attributes:
        places: float64 [num_images, 3] latitude and longitude in degrees, altitude in metres
            (WGS 84); NaN where unknown.
        gravity: float64 [num_images, 3] direction of gravity in axes of the camera, see
            `Positions`; NaN where unknown.
        place: the single position of a whole video; None if there is none, or if images have
            positions.
        warnings: warnings about the positions.
    """

    places: Floats
    gravity: Floats
    place: tuple[float, float, float] | None
    warnings: tuple[str, ...] = ()

    @property
    def digest(self) -> str:
        """Digest of the positions and directions of gravity."""
        arrays = self.places.tobytes() + self.gravity.tobytes()
        return hashlib.sha256(arrays + repr(self.place).encode()).hexdigest()

    def some(self, index: Ints) -> ImagePositions:
        """Select images by their indices."""
        return replace(self, places=self.places[index], gravity=self.gravity[index])


def image_positions(
    image_set: ImageSet, videos: Sequence[Video], photos: Sequence[Photo]
) -> ImagePositions:
    """Find the positions of images; those of video frames are interpolated by time.

    Args:
        image_set: the images.
        videos: the videos, of any codec.
        photos: the photos.

    Raises:
        VideoError: a file cannot be read.
    """
    places = np.full((len(image_set.sequence), 3), np.nan)
    gravity = np.full_like(places, np.nan)
    one: list[tuple[float, float, float]] = []
    notes: list[str] = []
    for number, video in enumerate(videos):
        found = read_positions(video)
        if found is None:
            continue
        notes += [found.ignored] if found.ignored is not None else []
        one += [found.place] if found.place is not None else []
        if not (len(found.times) or len(found.gravity_times)):
            continue
        images, frames = image_set.images_of(number), image_set.of_video(number).frames
        times = _times_since_start(video)
        if times is not None and len(frames) and frames[-1] < len(times):
            own = slice(images.start, images.stop)
            places[own] = _places(found, times[frames])
            gravity[own] = _gravity(found, times[frames])
    first = len(image_set.sequence) - len(photos)
    for index, photo in enumerate(photos, start=first):
        if photo.place is not None and are_places(np.array([photo.place]))[0]:
            places[index] = photo.place
    no_path = not np.isfinite(places).any() and one
    return ImagePositions(places, gravity, one[0] if no_path else None, tuple(notes))


def _times_since_start(video: Video) -> Floats | None:
    """Times in seconds after the first picture of the frames that players show; None if unknown."""
    times = picture_times(video)
    if times is None:
        return None
    since: Floats = times - times[0]
    if video.presented is None:
        return since
    return np.asarray(since[video.presented[video.presented < len(since)]])


def _places(found: Positions, times: Floats) -> Floats:
    # Positions on both sides of the date line are close to each other.
    east = np.unwrap(found.places[:, 1], period=360.0)
    places = np.column_stack([found.places[:, 0], east, found.places[:, 2]])
    between = interpolate(times, found.times, places)
    between[:, 1] = (between[:, 1] + 180) % 360 - 180
    return between


def _gravity(found: Positions, times: Floats) -> Floats:
    between = interpolate(times, found.gravity_times, found.gravity)
    length = np.linalg.norm(between, axis=1, keepdims=True)
    return np.asarray(between / np.where(length > 0, length, np.nan))
