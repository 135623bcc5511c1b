"""Seams at which a model may be bent by false links.

False links, for example between two walls that look alike, may place the images after a seam where
they do not belong. The model is then bent although many points join its parts. The tracks across
the seam show it: bundle adjustment has dropped them because they contradict the poses. If there are
no tracks, and hardly any points connect the images on either side, nothing confirms the links.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.two_view_models import error_by_poses
from colmap_av1.tracks.tracks import Tracks

# A track fits the poses of two images if its Sampson error is at most this, in pixels.
_MAX_ERROR = 4.0
# A seam is contradicted if fewer than this share of its tracks fit. On 17 rendered walks, 9 % fit
# at a seam where false links bent the model, and 59 % or more at all others.
_LEAST_FITTING = 0.4
# Fewer tracks neither contradict nor confirm poses.
_FEWEST = 30


def unconfirmed_seams(
    model: PosedModel,
    image_set: ImageSet,
    tracks: Tracks,
    seams: Sequence[tuple[str, str]],
    few_points: Collection[tuple[str, str]],
) -> list[tuple[str, str]]:
    """The seams across which most tracks contradict the poses, or neither tracks nor points join.

    Args:
        model: the poses.
        image_set: all images.
        tracks: the tracks of all videos.
        seams: names of the images before and after each seam.
        few_points: those that hardly any points join, see `Seams.few_points`.
    """
    order, bounds = tracks.by_frame()
    track, frame_of, poses = tracks.track, image_set.images.frame_of, model.by_name

    def is_unconfirmed(names: tuple[str, str]) -> bool:
        views = [poses[name] for name in names]
        cameras = [model.cameras[view.camera_id] for view in views]
        seen = [order[bounds[f] : bounds[f + 1]] for f in (frame_of[name] for name in names)]
        first, second = (track[own] for own in seen)
        _, *both = np.intersect1d(first, second, return_indices=True)
        if len(both[0]) < _FEWEST:
            return names in few_points
        rays = [
            np.asarray(camera.cam_from_img(tracks.xy[own[rows]].astype(np.float64))).T
            for camera, own, rows in zip(cameras, seen, both, strict=True)
        ]
        error = error_by_poses([view.cam_from_world for view in views], cameras, rays)
        return bool(np.mean(error <= _MAX_ERROR) < _LEAST_FITTING)

    return [seam for seam in seams if is_unconfirmed(seam)]
