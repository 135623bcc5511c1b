"""Number and length of tracks, and how they cover the images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks

# Lengths are counted from each of these up to the next.
LENGTHS = (2, 4, 8, 16, 32)
_CELL = 16


@dataclass(frozen=True)
class TrackStatistics:
    """Figures of tracks, counted in images.

    Attributes:
        num_images: number of images.
        num_tracks: tracks that two or more images see.
        mean_length: images that see a track, on average.
        tracks_by_length: number of tracks by the smallest length of their class, see LENGTHS.
        observations_per_image: observations of an image on average, and in the image that has
            the fewest.
        coverage: share of an image's cells of 16x16 px that hold an observation, on average and
            in the image that has the lowest.
    """

    num_images: int
    num_tracks: int
    mean_length: float
    tracks_by_length: dict[int, int]
    observations_per_image: tuple[float, int]
    coverage: tuple[float, float]


def track_statistics(tracks: Tracks, frames: NDArray[np.integer] | None = None) -> TrackStatistics:
    """Count tracks and the image area that they cover.

    Args:
        tracks: the tracks.
        frames: the frames that are images; every frame of the video if None.
    """
    images = np.arange(tracks.num_frames) if frames is None else np.unique(frames)
    is_image = np.zeros(tracks.num_frames, dtype=bool)
    is_image[images] = True
    track = tracks.track
    seen = is_image[tracks.frame]
    length = np.bincount(track[seen], minlength=tracks.num_tracks)
    # What a single image sees is no track.
    seen &= length[track] >= 2
    length = length[length >= 2]

    observations = np.bincount(tracks.frame[seen], minlength=tracks.num_frames)[images]
    columns, rows = math.ceil(tracks.width / _CELL), math.ceil(tracks.height / _CELL)
    cell = (tracks.xy[seen] // _CELL).astype(np.int64)
    column = np.clip(cell[:, 0], 0, columns - 1)
    row = np.clip(cell[:, 1], 0, rows - 1)
    place = (tracks.frame[seen].astype(np.int64) * rows + row) * columns + column
    covered = np.zeros(tracks.num_frames * rows * columns, dtype=bool)
    covered[place] = True
    coverage = covered.reshape(tracks.num_frames, -1)[images].mean(1)
    bounds = (*LENGTHS, np.iinfo(np.int64).max)
    counts = np.histogram(length, bounds)[0]
    return TrackStatistics(
        num_images=len(images),
        num_tracks=len(length),
        mean_length=float(length.mean()) if len(length) else 0.0,
        tracks_by_length={low: int(n) for low, n in zip(LENGTHS, counts, strict=True)},
        observations_per_image=(float(observations.mean()), int(observations.min())),
        coverage=(float(coverage.mean()), float(coverage.min())),
    )
