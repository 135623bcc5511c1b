"""Images that the joint estimate does not register are assigned to models."""

from __future__ import annotations

import numpy as np
from image_sets import images, tracks_from

from colmap_av1.poses.unregistered import models_of_images, within_models
from colmap_av1.tracks.tracks import Tracks


def frames(*index: int) -> np.ndarray:
    return np.array(index, np.int32)


def test_short_unregistered_stretches_join_the_surrounding_model() -> None:
    image_set = images(20)
    first, second = frames(2, 3, 4, 8, 9), frames(13, 14, 18, 19)
    of_images = models_of_images(Tracks.empty(20, (64, 48)), [first, second], image_set)
    # Frames 0 and 1 are at the start of the video, 5 to 7 and 15 to 17 lie within a model, and
    # 10 to 12 lie between two models.
    assert of_images.tolist() == [0] * 10 + [-1] * 3 + [1] * 7


def test_long_unregistered_stretches_join_no_model() -> None:
    image_set = images(20)
    registered = frames(4, 5, 6, 11, 12)
    of_images = models_of_images(Tracks.empty(20, (64, 48)), [registered], image_set)
    assert np.flatnonzero(of_images == 0).tolist() == registered.tolist()


def test_unregistered_video_joins_the_model_that_shares_its_tracks() -> None:
    image_set = images(4, 4, 6)
    tracks = tracks_from([[3, 9], [5, 9, 10], [6, 11, 12]], num_frames=14)
    of_images = models_of_images(tracks, [frames(0, 1, 2, 3), frames(4, 5, 6, 7)], image_set)
    assert of_images.tolist() == [0] * 4 + [1] * 10


def test_tracks_are_split_between_models() -> None:
    image_set = images(16)
    left = [image_set.images.names[i] for i in (2, *range(6, 10))]
    of_images = np.array([0] * 6 + [-1] * 4 + [1] * 6)
    tracks = tracks_from([[1, 2, 3, 7, 12], [4, 5, 6], [7, 8, 9]], num_frames=16)
    parts = within_models(tracks, left, of_images, image_set)
    # The rest of the first track, in the second model, observes no unregistered image.
    assert parts.frame.tolist() == [1, 2, 3]
