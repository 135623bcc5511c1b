"""Resection: estimate the poses of images between key images from the key images' points."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.cameras import poselib_camera
from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.track_points import TriangulatedTracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.util.digests import seed_of
from colmap_av1.util.grouping import grouped, indices_in
from colmap_av1.util.threads import map_on_threads

# Largest error in pixels of an inlier, and smallest number of inliers of an accepted pose, as in
# COLMAP's mapper.
_MAX_ERROR = 4.0
_MIN_INLIERS = 30
# Scale in pixels of the Cauchy loss of the refinement.
_LOSS_SCALE = 0.5
# Most initial poses are already good, so a few RANSAC samples suffice.
_MIN_SAMPLES = 10
_MAX_SAMPLES = 1000


@dataclass(frozen=True)
class Sightings:
    """Observations of 3D points in images without a pose.

    Attributes:
        rays: float64 [n, 2] undistorted position (x / z, y / z) of each observation.
        xyz: float64 [n, 3] the 3D point of each observation.
        bounds: int64 [num_images + 1]; image i has the observations bounds[i] : bounds[i + 1].
    """

    rays: Floats
    xyz: Floats
    bounds: Ints


def sightings_of(
    known: TriangulatedTracks,
    tracks: Tracks,
    frames: NDArray[np.int32],
    cameras: Sequence[pycolmap.Camera],
) -> Sightings:
    """Collect the observations, in frames without a pose, of the points of tracks.

    Args:
        known: the tracks in the frames with known poses, and their points.
        tracks: the same tracks in all frames.
        frames: int32 [num_images] ascending frames without a pose.
        cameras: the pycolmap.Camera of each of these frames.
    """
    number = tracks.track
    points, seen = known.points, known.tracks
    is_known = np.zeros(tracks.num_frames, dtype=np.bool_)
    is_known[seen.frame] = True
    in_seen = np.unique(number[is_known[tracks.frame]])
    # A track that slid from one surface to another may have two points: the first is used.
    first = points.observation[points.offsets[:-1]]
    own, index = np.unique(np.searchsorted(seen.offsets, first, side="right"), return_index=True)
    point = np.full(tracks.num_tracks, -1, dtype=np.int64)
    point[in_seen[own - 1]] = index
    image = indices_in(frames, tracks.num_frames)[tracks.frame]
    rows = np.flatnonzero((image >= 0) & (point[number] >= 0))
    order, bounds = grouped(image[rows], len(frames))
    rows = rows[order]
    xy = tracks.xy[rows].astype(np.float64)
    rays = np.empty(xy.shape)
    for camera, first_row, last_row in zip(cameras, bounds[:-1], bounds[1:], strict=True):
        own_rows = slice(int(first_row), int(last_row))
        rays[own_rows] = np.asarray(camera.cam_from_img(xy[own_rows])).reshape(-1, 2)
    return Sightings(rays, points.xyz[point[number[rows]]], bounds)


def resect(
    sightings: Sightings,
    guesses: Floats,
    focal: Floats,
    *,
    loss_scale: float = _LOSS_SCALE,
    seed: int = 0,
    num_threads: int | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Floats | None]:
    """Estimate the pose of each image from its observations, with PoseLib.

    Args:
        sightings: the observations of points in the images.
        guesses: float64 [num_images, 3, 4] initial poses, x_cam = R x_world + t.
        focal: float64 [num_images] focal lengths in pixels, which convert errors to pixels.
        loss_scale: scale in pixels of the Cauchy loss.
        seed: random seed of the samples.
        num_threads: number of threads; None: one per CPU. The result does not depend on it.
        progress: called with the number of images done so far.

    Returns:
        The pose float64 [3, 4] of each image; None for images with fewer than 30 inliers.
    """

    def work(image: int) -> Floats | None:
        own = slice(int(sightings.bounds[image]), int(sightings.bounds[image + 1]))
        rays, xyz = sightings.rays[own], sightings.xyz[own]
        return _resect_one(
            rays,
            xyz,
            guesses[image],
            float(focal[image]),
            loss_scale=loss_scale,
            seed=seed_of(seed, image),
        )

    found: list[Floats | None] = []
    for pose in map_on_threads(work, range(len(guesses)), num_threads):
        found.append(pose)
        if progress is not None:
            progress(len(found))
    return found


def _resect_one(
    rays: Floats,
    xyz: Floats,
    guess: Floats,
    focal: float,
    *,
    loss_scale: float,
    seed: int,
) -> Floats | None:
    import poselib  # noqa: PLC0415 - after NumPy

    if len(rays) < _MIN_INLIERS:
        return None
    camera = poselib_camera(focal)
    ransac = {
        "max_reproj_error": _MAX_ERROR,
        "min_iterations": _MIN_SAMPLES,
        "max_iterations": _MAX_SAMPLES,
        "seed": seed,
    }
    bundle = {"loss_type": "CAUCHY", "loss_scale": loss_scale}
    start = poselib.CameraPose()
    start.R, start.t = guess[:, :3], guess[:, 3]
    pose, info = poselib.estimate_absolute_pose(rays * focal, xyz, camera, ransac, bundle, start)
    if info["num_inliers"] < _MIN_INLIERS:
        return None
    return np.column_stack([np.asarray(pose.R), np.asarray(pose.t)])


def interpolate_poses(
    cam_from_world: Floats, frames: NDArray[np.int32], wanted: NDArray[np.int32]
) -> Floats:
    """Interpolate poses: linear interpolation of camera centres, spherical of rotations.

    Args:
        cam_from_world: float64 [n, 3, 4] known poses.
        frames: int32 [n] their frames, ascending.
        wanted: int32 [m] frames to interpolate; frames before the first and after the last known
            pose get that pose.

    Returns:
        float64 [m, 3, 4] cam_from_world.
    """
    from scipy.spatial.transform import Rotation, Slerp  # noqa: PLC0415 - slow to import

    if len(frames) == 1:
        return np.repeat(cam_from_world, len(wanted), axis=0)
    at = np.clip(wanted, frames[0], frames[-1]).astype(np.float64)
    turns = Slerp(frames.astype(np.float64), Rotation.from_matrix(cam_from_world[:, :, :3]))
    rotation = turns(at).as_matrix()
    centres = camera_centres(cam_from_world)
    centre = np.column_stack([np.interp(at, frames, along) for along in centres.T])
    translation = -np.einsum("nij,nj->ni", rotation, centre)
    return np.concatenate([rotation, translation[:, :, None]], axis=2)
