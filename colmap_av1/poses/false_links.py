"""Seams at which a model is probably bent by false links.

False links, for example between two doors that look alike, may place the images after a seam where
they do not belong. The model is then bent although many points join its parts. The tracks across
the seam show it: bundle adjustment has dropped them because they contradict the poses. Without
tracks, the speed of the camera shows it: at the wrong one of two doors, it has moved much further
than it can have moved in the images that are lost at the seam.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.coverage import views_of
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.two_view_models import error_of_pixels
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.grouping import with_equal_keys

# A track fits the poses of two images if its Sampson error is at most this, in pixels.
_MAX_ERROR = 4.0
# A seam is contradicted if fewer than this share of its tracks fit. On 17 rendered walks, 9 % fit
# at a seam where false links bent the model, and 59 % or more at all others.
_LEAST_FITTING = 0.4
# Fewer tracks show nothing.
_FEWEST = 30
# A camera moves too fast across a seam if its speed exceeds this multiple of the speed that it
# hardly ever exceeds elsewhere in the video. On 21 rendered walks, it was 2.2 where false links
# bent the model, and at most 0.54 at other seams without tracks and with few points.
_TOO_FAST = 1.5
_HARDLY_EVER = 0.9  # a quantile


def contradicted_seams(
    model: PosedModel, image_set: ImageSet, tracks: Tracks, seams: Sequence[tuple[str, str]]
) -> list[tuple[str, str]]:
    """The seams across which most tracks contradict the poses.

    Args:
        model: the poses.
        image_set: all images.
        tracks: the tracks of all videos.
        seams: names of the images before and after each seam.
    """
    shares = _shares_fitting(model, image_set, tracks, seams)
    return [
        seam
        for seam, share in zip(seams, shares, strict=True)
        if share is not None and share < _LEAST_FITTING
    ]


def jumping_seams(
    model: PosedModel, image_set: ImageSet, tracks: Tracks, seams: Sequence[tuple[str, str]]
) -> list[tuple[str, str]]:
    """The seams with fewer than 30 tracks across which the camera moves too fast.

    Args:
        model: the poses.
        image_set: all images.
        tracks: the tracks of all videos.
        seams: names of the images before and after each seam.
    """
    shares = _shares_fitting(model, image_set, tracks, seams)
    speeds = _relative_speeds(model, image_set)
    return [
        seam
        for seam, share in zip(seams, shares, strict=True)
        if share is None and speeds[seam] > _TOO_FAST
    ]


def _shares_fitting(
    model: PosedModel, image_set: ImageSet, tracks: Tracks, seams: Sequence[tuple[str, str]]
) -> list[float | None]:
    """The share of the tracks across each seam that fit the poses; None for few tracks."""
    if not seams:
        return []
    by_frame, track = tracks.by_frame(), tracks.track
    frame_of, poses = image_set.images.frame_of, model.by_name

    def share(names: tuple[str, str]) -> float | None:
        seen = with_equal_keys(track, *(by_frame[frame_of[name]] for name in names))
        if len(seen[0]) < _FEWEST:
            return None
        views = views_of([poses[name] for name in names], model.cameras)
        error = error_of_pixels(views, [tracks.xy[own] for own in seen])
        return float(np.mean(error <= _MAX_ERROR))

    return [share(seam) for seam in seams]


def _relative_speeds(model: PosedModel, image_set: ImageSet) -> dict[tuple[str, str], float]:
    """The speed of the camera between neighbouring images, by their names.

    It is relative to the speed that the camera hardly ever exceeds in the same video.
    """
    poses, images = model.by_name, image_set.images
    index = np.array([k for k, name in enumerate(images.names) if name in poses])
    centres = camera_centres(np.array([poses[images.names[k]].cam_from_world for k in index]))
    found = dict[tuple[str, str], float]()
    for sequence in np.unique(image_set.sequence[index]):
        own = np.flatnonzero(image_set.sequence[index] == sequence)
        distance = np.linalg.norm(np.diff(centres[own], axis=0), axis=1)
        speed = distance / np.diff(images.frames[index[own]])
        usual = np.quantile(speed, _HARDLY_EVER) if len(speed) else 0.0
        names = [images.names[k] for k in index[own]]
        relative = np.divide(speed, usual, out=np.ones_like(speed), where=usual > 0)
        found |= dict(zip(pairwise(names), relative.tolist(), strict=True))
    return found
