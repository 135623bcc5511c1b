"""Corners in the registered images, for bundle adjustment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.masks import Mask
from colmap_av1.geometry.posed_camera import views_of
from colmap_av1.geometry.resection import resect, sightings_of
from colmap_av1.poses.corners.grey_pictures import GreyPictures
from colmap_av1.poses.corners.patch_matching import match_patches
from colmap_av1.poses.posed_images import FROM_PICTURES, PosedImages, triangulate_in
from colmap_av1.poses.run import Run
from colmap_av1.tracks.corners import CornerDensity, follow_corners
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Floats
from colmap_av1.util.progress import progress_in

# Scale in pixels of the Cauchy loss when an image is resected. It exceeds the distortion by a
# rolling shutter, so that no part of the picture dominates.
_LOSS_SCALE = 2.0
# Corner density where the masks of a video change: dynamic objects halve the length of the tracks
# they occlude, and short tracks connect fewer images.
_DENSE = CornerDensity(most=1500, spacing=8)
# Reprojection errors are clipped to this many pixels when two poses are compared.
_MAX_ERROR = 8.0


def corners_in_images(
    run: Run, tracks: Tracks, registered: PosedImages
) -> tuple[Tracks, PosedImages]:
    """Find corners in the images of all videos, and correct poses that contradict them.

    Args:
        run: inputs and options of the run.
        tracks: tracks of static points, which guide the search.
        registered: the registered images; their masks exclude dynamic pixels.

    Returns:
        The corners as tracks, and the images with the corrected poses.
    """
    with GreyPictures(run.stages) as pictures:
        followed = _followed(run, tracks, registered, pictures)
        registered = resect_from_corners(run, followed, registered)
        return _match_in_all(run, followed, registered, pictures), registered


def _followed(
    run: Run,
    tracks: Tracks,
    registered: PosedImages,
    pictures: GreyPictures,
) -> Tracks:
    """Follow corners through the images of each video, and store the pictures."""
    image_of = {int(frame): i for i, frame in enumerate(registered.frames)}
    found = Tracks.empty(tracks.num_frames, (tracks.width, tracks.height))
    for video in range(len(run.shown)):
        own = registered.of_video(video)
        if len(own.images) == 0:
            continue
        first = int(own.image_set.first_frame[video])
        mask_of = dict(zip((own.frames - first).tolist(), own.image_set.masks, strict=True))
        guide = tracks.keep_frames(own.frames)
        num_frames = max(mask_of) + 1
        guide = replace(guide, frame=guide.frame - np.int32(first), num_frames=num_frames)
        decoded = run.shown[video].pictures(
            num_frames, run.options.match.reading, wanted=mask_of, use="corners are followed"
        )
        report = progress_in(run.progress, "refinement", len(own.images))
        density = _DENSE if len(set(mask_of.values())) > 1 else CornerDensity()

        def keep(frame: int, grey: NDArray[np.uint8], first: int = first) -> None:
            pictures.keep(image_of[first + frame], grey)

        corners = follow_corners(
            guide, decoded, partial(_are_valid, mask_of), report, density=density, keep=keep
        )
        found = Tracks.concatenate(found, replace(corners, frame=corners.frame + np.int32(first)))
    return found


def _match_in_all(
    run: Run,
    corners: Tracks,
    registered: PosedImages,
    pictures: GreyPictures,
) -> Tracks:
    """Locate corners in all images that see them, see `match_patches`."""
    found = triangulate_in(run, registered, corners, FROM_PICTURES)
    views = views_of(registered.images, registered.cameras, registered.image_set.masks)
    report = progress_in(run.progress, "refinement", len(views))
    return match_patches(
        found,
        views=views,
        frames=registered.frames,
        pictures=pictures,
        num_threads=run.context.num_threads,
        progress=report,
    )


def resect_from_corners(run: Run, corners: Tracks, registered: PosedImages) -> PosedImages:
    """Resect images from the points of corners, and keep the poses that fit these better.

    Where many motion vectors share an error, an image gets a wrong pose that agrees with them. An
    adjustment that starts there treats the correct observations as outliers and cannot recover.

    Args:
        run: inputs and options of the run.
        corners: corners as tracks.
        registered: the registered images.
    """
    found = triangulate_in(run, registered, corners, FROM_PICTURES)
    if len(found.points.xyz) == 0:
        return registered
    images = list(registered.images)
    cameras = registered.camera_of_image
    sightings = sightings_of(found, found.tracks, registered.frames, cameras)
    focal = np.array([camera.mean_focal_length() for camera in cameras])
    poses = resect(
        sightings,
        np.array([image.cam_from_world for image in images]),
        focal,
        loss_scale=_LOSS_SCALE,
        seed=run.context.seed,
        num_threads=run.context.num_threads,
    )
    for i, pose in enumerate(poses):
        own = slice(int(sightings.bounds[i]), int(sightings.bounds[i + 1]))
        shown = sightings.rays[own] * focal[i], sightings.xyz[own], float(focal[i])
        if pose is not None and _error(*shown, pose) < _error(*shown, images[i].cam_from_world):
            images[i] = replace(images[i], cam_from_world=pose)
    return replace(registered, model=replace(registered.model, images=images))


def _error(
    xy: Floats,
    xyz: Floats,
    focal: float,
    cam_from_world: Floats,
) -> float:
    """Mean reprojection error in pixels, clipped; points behind the camera count as the limit."""
    in_camera = xyz @ cam_from_world[:, :3].T + cam_from_world[:, 3]
    error = np.linalg.norm(in_camera[:, :2] / in_camera[:, 2:] * focal - xy, axis=1)
    return float(np.where(in_camera[:, 2] > 0, np.minimum(error, _MAX_ERROR), _MAX_ERROR).mean())


def _are_valid(
    mask_of: Mapping[int, Mask | None],
    frame: int,
    xy: NDArray[np.float32],
    size: tuple[int, int],
) -> Bools:
    """Whether positions in the picture of a frame are valid; all are if it has no mask."""
    mask = mask_of[frame]
    return mask.keeps(xy, size) if mask is not None else np.ones(len(xy), np.bool_)
