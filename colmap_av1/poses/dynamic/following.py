"""Tracks near dynamic objects, refined on the pictures and continued after an occlusion.

A passing object ends the tracks behind it, and an encoder that follows the object moves the static
points next to it along with it. Such tracks make the poses worse, however many there are.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.posed_camera import PosedCamera, views_of
from colmap_av1.geometry.track_points import TriangulatedTracks, triangulate_tracks
from colmap_av1.images.image_set import ImageSet
from colmap_av1.options import RefineOptions
from colmap_av1.poses.posed_images import FOR_POSES, PosedImages
from colmap_av1.poses.run import Run
from colmap_av1.tracks.refine import refine_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools
from colmap_av1.util.grouping import groups
from colmap_av1.util.progress import progress_in

# Number of images after the last observation of a point in which it is searched; later its
# surroundings look too different.
_REACH = 15
# Width in pixels of the border of a picture that is not searched.
_MARGIN = 4
# Expected error in pixels of a projection before the poses are adjusted.
_PREDICTED_SIGMA = 1.0
_LK = RefineOptions(refine="lk")


def has_changing_masks(image_set: ImageSet) -> bool:
    """Whether the masks of a video differ between its images."""
    videos = (image_set.images_of(video) for video in range(len(image_set.videos)))
    return any(len({image_set.masks[image] for image in images}) > 1 for images in videos)


def follow_occluded(run: Run, tracks: Tracks, registered: PosedImages) -> Tracks:
    """Refine tracks on the pictures, and find their points in more images.

    A point is searched at its projection in images without an observation of it, from its first
    observation to shortly after its last, except on dynamic pixels. It is observed where the
    picture matches one that shows it. Projections without a match are dropped: they would agree
    with any poses.

    Args:
        run: inputs and options of the run.
        tracks: tracks of static points; few, since each is searched in many pictures.
        registered: the registered images; their masks exclude dynamic pixels.

    Returns:
        A track for each point, in these images, without outliers.
    """
    found = Tracks.empty(tracks.num_frames, (tracks.width, tracks.height))
    for video in range(len(run.shown)):
        own = registered.of_video(video)
        if len(own.images) == 0:
            continue
        views = views_of(own.images, own.cameras, own.image_set.masks)
        triangulated = triangulate_tracks(
            tracks,
            own.frames,
            views,
            options=FOR_POSES,
            num_threads=run.context.num_threads,
        )
        if len(triangulated.points.xyz) == 0:  # The camera of this video stands still.
            continue
        expected, is_expected = expect_in_views(triangulated, views, own.frames)
        first_frame = int(own.image_set.first_frame[video])
        corrected = _on_pictures(run, video, expected, is_expected, first_frame)
        found = Tracks.concatenate(
            found, corrected.keep_observations(corrected.confirmed | ~is_expected)
        )
    return found


def _on_pictures(run: Run, video: int, tracks: Tracks, expected: Bools, first_frame: int) -> Tracks:
    """Refine tracks on the pictures of their video; their frames count through all videos."""
    frame = tracks.frame - np.int32(first_frame)
    wanted = frozenset(np.unique(frame).tolist())
    shown = run.shown[video]
    width, height = shown.size
    num_frames = max(wanted) + 1
    own = replace(tracks, frame=frame, num_frames=num_frames, width=width, height=height)
    decoded = shown.pictures(
        num_frames, run.options.match.reading, wanted=wanted, use="tracks are refined"
    )
    report = progress_in(run.progress, "refinement", len(wanted))
    found = refine_tracks(own, decoded, _LK, report, expected=expected)
    return replace(tracks, xy=found.xy, sigma=found.sigma, confirmed=found.confirmed)


def expect_in_views(
    triangulated: TriangulatedTracks,
    views: Sequence[PosedCamera],
    frames: NDArray[np.int32],
) -> tuple[Tracks, Bools]:
    """Points as tracks, with their projections into views between and after their observations.

    Args:
        triangulated: the points, and the tracks that they come from.
        views: images of one video with their masks, in temporal order.
        frames: int32 [num_views] their frames.

    Returns:
        A track for each point, and bool [num_observations] which of its observations are
        projections.
    """
    tracks, points = triangulated.tracks, triangulated.points
    num_points = len(points.xyz)
    point = points.point
    seen_by = triangulated.view[points.observation]
    first, last = seen_by[points.offsets[:-1]], seen_by[points.offsets[1:] - 1]
    by_view = groups(seen_by, len(views))
    points_in, xy_in = [point], [tracks.xy[points.observation]]
    for number, camera in enumerate(views):
        near = np.flatnonzero((first < number) & (last >= number - _REACH))
        there = np.setdiff1d(near, point[by_view[number]])
        index, xy, _ = camera.project(points.xyz[there])
        index = there[index]
        inside = (xy >= _MARGIN) & (xy <= np.array(camera.size) - _MARGIN)
        new = np.asarray(inside.all(axis=1))
        new[new] = camera.keeps(xy[new])
        points_in.append(index[new])
        xy_in.append(xy[new].astype(np.float32))
    counts = [len(own) for own in points_in]
    owner = np.concatenate(points_in)
    at = np.concatenate([seen_by, np.repeat(np.arange(len(views)), counts[1:])])
    order = np.lexsort((at, owner))
    is_predicted = (np.arange(len(owner)) >= counts[0])[order]
    sigma = np.full(len(owner), _PREDICTED_SIGMA, np.float32)
    sigma[: counts[0]] = tracks.sigma[points.observation]
    expected = replace(
        tracks,
        offsets=np.searchsorted(owner[order], np.arange(num_points + 1)).astype(np.int64),
        frame=frames[at[order]],
        xy=np.concatenate(xy_in)[order],
        sigma=sigma[order],
        confirmed=np.zeros(len(owner), np.bool_),
    )
    return expected, is_predicted
