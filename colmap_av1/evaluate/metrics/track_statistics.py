"""Number, length and image coverage of tracks."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.tracks.tracks import Tracks

# Lower bounds of the classes that track lengths are counted in.
LENGTHS = (2, 4, 8, 16, 32)
_CELL = 16


@dataclass(frozen=True)
class TrackStatistics:
    """Figures of tracks, counted in images.

    Attributes:
        num_images: number of images.
        num_tracks: number of tracks that two or more images observe.
        mean_length: mean number of images that observe a track.
        tracks_by_length: number of tracks by the lower bound of their class, see LENGTHS.
        observations_per_image: number of observations of an image, mean and minimum.
        coverage: share of an image's cells of 16x16 pixels with an observation, mean and minimum.
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
        frames: the frames that are images; all frames of the video if None.
    """
    images = np.arange(tracks.num_frames) if frames is None else np.unique(frames)
    is_image = np.zeros(tracks.num_frames, dtype=bool)
    is_image[images] = True
    track = tracks.track
    seen = is_image[tracks.frame]
    length = np.bincount(track[seen], minlength=tracks.num_tracks)
    # Drop tracks that only one image observes.
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
