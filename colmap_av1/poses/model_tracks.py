"""Tracks of models, and their positions compared with those of other tracks."""

from __future__ import annotations

import numpy as np

from colmap_av1.geometry.cameras import largest_size
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.geometry.track_points import tracks_of_points
from colmap_av1.images.image_set import ImageSet
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints


def tracks_of_model(model: PosedModel, image_set: ImageSet) -> Tracks:
    """The observations of a model's points as tracks through the frames of its images."""
    frame_of = image_set.images.frame_of
    frames = np.array([frame_of[image.name] for image in model.images], np.int32)
    size = largest_size(model.cameras.values())
    return tracks_of_points(model.points, frames, image_set.num_frames, size)


def at_same_place(tracks: Tracks, others: Tracks, distance: float) -> Bools:
    """Which tracks have an observation at the position of an observation of one of the others.

    Args:
        tracks: the tracks.
        others: tracks through the same frames, in the same pixels.
        distance: distance in pixels up to which positions are the same. Cells of this size are
            compared, so that some positions up to three times as far apart count as well.

    Returns:
        bool [num_tracks].
    """
    if tracks.num_tracks == 0 or others.num_tracks == 0:
        return np.zeros(tracks.num_tracks, np.bool_)
    columns = int(max(tracks.width, others.width) / distance) + 3
    rows = int(max(tracks.height, others.height) / distance) + 3

    def cells(own: Tracks) -> Ints:
        at: Ints = (own.xy / distance).astype(np.int64) + 1
        return np.asarray((own.frame.astype(np.int64) * rows + at[:, 1]) * columns + at[:, 0])

    around = np.array([dy * columns + dx for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
    is_there = np.isin(cells(tracks), (cells(others)[:, None] + around).ravel())
    return tracks.having(is_there)
