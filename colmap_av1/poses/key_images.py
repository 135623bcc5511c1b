"""The key images of a video, by the options of a run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.key_images import key_images
from colmap_av1.matching.links.plan import images_to_link
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints


def key_images_of_video(
    run: Run,
    tracks: Tracks,
    chosen: ChosenImages,
    inter_share: NDArray[np.float32],
    fast: Bools,
) -> Ints:
    """Indices of the key images among some images of a video.

    Args:
        run: the run.
        tracks: tracks of the video.
        chosen: the images.
        inter_share: see `TrackedVideo`.
        fast: bool [num_frames] where the camera moves fast, see `fast_frames`.
    """
    pose_options, links = run.options.poses, run.options.match.links
    always = images_to_link(inter_share, chosen.frames, links)
    if links.links != "none":
        always |= fast[chosen.frames]
    return key_images(
        tracks,
        chosen.frames,
        always,
        spacing=pose_options.pose_spacing,
        num_cells=pose_options.pose_tracks_per_image,
    )
