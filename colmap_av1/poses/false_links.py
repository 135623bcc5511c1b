"""Seams at which a model is probably bent by false links.

False links, for example between two doors that look alike, may place the images after a seam where
they do not belong. The model is then bent although many points join its parts. The tracks across
the seam show it: bundle adjustment has dropped them because they contradict the poses. Without
tracks, the speed of the camera shows it: at the wrong one of two doors, it has moved much further
than it can have moved in the images that are lost at the seam. In a turn, motion may follow the
epipolar lines of wrong poses, so tracks fit although the poses are wrong. Where the camera leaps,
the points of each side of the seam are therefore compared with their tracks in the image on the
other side.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.posed_camera import views_of
from colmap_av1.geometry.posed_model import PosedModel
from colmap_av1.geometry.track_points import triangulate_tracks
from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.epipolar import error_of_pixels
from colmap_av1.poses.posed_images import FOR_POSES
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.grouping import with_equal_keys

# A track fits the poses of two images if its Sampson error is at most this, in pixels.
_MAX_ERROR = 4.0
# A seam is contradicted if fewer than this share of its tracks fit. On 17 rendered walks, 9 % fit
# at a seam where false links bent the model, and 59 % or more at all others.
_LEAST_FITTING = 0.4
# Fewer tracks or points show nothing.
_FEWEST = 30
# A camera moves too fast across a seam if its speed exceeds this multiple of this quantile of its
# speed elsewhere in the video. On 21 rendered walks, it was 2.2 where false links bent the model,
# and at most 0.54 at other seams without tracks and with few points.
_TOO_FAST, _SPEED_QUANTILE = 1.5, 0.9
# A camera leaps if it is this much faster. On 12 rendered walks, it was 8.3 times as fast where a
# model of few images was bent in a turn, and at most 1.7 times elsewhere.
_LEAP = 3.0
# Smallest number of images on one side that observe a point.
_FEWEST_VIEWS = 3
# Number of images on one side of a seam whose points are compared with the image on the other.
_NEAR = 10


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


def leaping_seams(model: PosedModel, image_set: ImageSet) -> list[tuple[str, str]]:
    """The neighbouring images of a video between which the camera leaps, by their names."""
    return [seam for seam, speed in _relative_speeds(model, image_set).items() if speed > _LEAP]


def misplaced_seams(
    model: PosedModel,
    image_set: ImageSet,
    tracks: Tracks,
    seams: Sequence[tuple[str, str]],
    *,
    num_threads: int | None = None,
) -> list[tuple[str, str]]:
    """The seams at which most points of either side do not project to their tracks on the other.

    Seams with few tracks are not examined, and neither are those whose tracks contradict the
    epipolar geometry: at a true leap, encoders find false motion.

    Args:
        model: the poses.
        image_set: all images.
        tracks: the tracks of all videos.
        seams: names of the images before and after each seam.
        num_threads: number of threads; None: one per CPU.
    """
    frame_of = image_set.images.frame_of
    images = sorted(model.images, key=lambda image: frame_of[image.name])
    frames = np.array([frame_of[image.name] for image in images], np.int32)
    views = views_of(images, model.cameras)

    def fits(side: range, other: int) -> bool:
        near = tracks.keep_frames(np.append(frames[side], frames[other]))
        near = near.keep_tracks(near.having(near.frame == frames[other]))
        near = near.keep_tracks(near.lengths > _FEWEST_VIEWS)
        found = triangulate_tracks(
            near, frames[side], [views[k] for k in side], options=FOR_POSES, num_threads=num_threads
        )
        first = found.points.observation[found.points.offsets[:-1]]
        at = near.xy[near.frame == frames[other]][found.tracks.track[first]]
        local = views[other].in_camera(found.points.xyz)
        error = np.linalg.norm(views[other].pixels(local) - at, axis=1)
        is_near = (local[:, 2] > 0) & (error <= _MAX_ERROR)
        return len(error) < _FEWEST or float(np.mean(is_near)) >= _LEAST_FITTING

    index = {image.name: k for k, image in enumerate(images)}
    video = image_set.sequence[np.searchsorted(image_set.images.frames, frames)]
    found = []
    shares = _shares_fitting(model, image_set, tracks, seams)
    for seam, share in zip(seams, shares, strict=True):
        if share is None or share < _LEAST_FITTING:
            continue
        last, first = (index[name] for name in seam)
        before = range(max(last + 1 - _NEAR, int(np.searchsorted(video, video[last]))), last + 1)
        end = int(np.searchsorted(video, video[first], side="right"))
        after = range(first, min(first + _NEAR, end))
        if not (fits(before, first) and fits(after, last)):
            found.append(seam)
    return found


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
        usual = np.quantile(speed, _SPEED_QUANTILE) if len(speed) else 0.0
        names = [images.names[k] for k in index[own]]
        relative = np.divide(speed, usual, out=np.ones_like(speed), where=usual > 0)
        found |= dict(zip(pairwise(names), relative.tolist(), strict=True))
    return found
