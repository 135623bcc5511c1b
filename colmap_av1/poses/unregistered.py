"""Matches of images that the joint estimate does not register."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import DensityOptions
from colmap_av1.poses.estimate_steps import Estimate
from colmap_av1.poses.run import Run
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Ints

# Up to this many consecutive images that are not registered belong to the model around them.
_LONGEST_GAP = 3


def tracks_of_unregistered(
    run: Run,
    estimate: Estimate,
    image_set: ImageSet,
    not_registered: Sequence[str],
    density: DensityOptions,
) -> Tracks:
    """Motion tracks and SIFT links with observations in images that are not registered.

    Args:
        run: the run.
        estimate: the first model.
        image_set: all images.
        not_registered: names of the images that are not registered.
        density: which motion tracks are selected.
    """
    motion = estimate.tracks.motion
    if not not_registered:
        return Tracks.empty(motion.num_frames, (motion.width, motion.height))
    frames, frame_of = image_set.images.frames, image_set.images.frame_of
    some = select_tracks(run.pose_tracks(motion).keep_frames(frames), density)
    seen = Tracks.concatenate(some, estimate.tracks.link_tracks.keep_frames(frames))
    is_wanted = np.isin(seen.frame, [frame_of[name] for name in not_registered])
    return seen.keep_tracks(seen.having(is_wanted))


def within_models(
    tracks: Tracks, not_registered: Sequence[str], model_of: Ints, image_set: ImageSet
) -> Tracks:
    """Split tracks so that none connects two models or leads to images that belong to none.

    Args:
        tracks: tracks with observations in images that are not registered.
        not_registered: names of the images that are not registered.
        model_of: see `models_of_images`.
        image_set: all images.

    Returns:
        The parts of the tracks in the images of each model that observe an image that is not
        registered.
    """
    image = np.searchsorted(image_set.images.frames, tracks.frame)
    is_wanted = np.isin(image_set.images.names, not_registered)[image]
    parts = [Tracks.empty(tracks.num_frames, (tracks.width, tracks.height))]
    for number in range(int(model_of.max()) + 1):
        in_model = model_of[image] == number
        touching = np.isin(tracks.track, tracks.track[in_model & is_wanted])
        parts.append(tracks.keep_observations(in_model & touching))
    return Tracks.concatenate(*parts)


def models_of_images(
    tracks: Tracks, registered: Sequence[NDArray[np.int32]], image_set: ImageSet
) -> Ints:
    """The model that each image belongs to, whether it is registered or not.

    Where the estimate does not register images, motion is unreliable. If it were matched there, a
    mapper would make bent models of these images, or join models at a wrong place. Therefore, only
    a few consecutive images belong to the model around them, or next to them at an end of the
    video. Images of videos without registered images, and photos, belong to the model that they
    share the most tracks with, or to the first if they share none: a mapper makes a separate model
    of them.

    Args:
        tracks: tracks with observations in images that are not registered.
        registered: for each model, the frames of its registered images.
        image_set: all images.

    Returns:
        int64 [num_images], -1 for images that belong to no model.
    """
    frames = image_set.images.frames
    model_of = np.full(len(frames), -1)
    for number, own_frames in enumerate(registered):
        model_of[np.searchsorted(frames, own_frames)] = number
    image = np.searchsorted(frames, tracks.frame)
    for sequence in np.unique(image_set.sequence):
        own = np.flatnonzero(image_set.sequence == sequence)
        known, left = own[model_of[own] >= 0], own[model_of[own] < 0]
        if len(known):
            gap = np.searchsorted(known, left)
            around = model_of[known[[0, *range(len(known)), -1]]]
            is_within = (around[gap] == around[gap + 1]) & (np.bincount(gap)[gap] <= _LONGEST_GAP)
            model_of[left] = np.where(is_within, around[gap], -1)
        else:
            touching = np.isin(tracks.track, tracks.track[np.isin(image, own)])
            shared = np.unique([tracks.track[touching], model_of[image[touching]]], axis=1)[1]
            model_of[own] = np.bincount(shared[shared >= 0], minlength=1).argmax()
    return model_of
