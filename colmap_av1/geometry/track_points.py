"""Triangulate all tracks on known poses, and colour the points."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.distant_points import splat_points
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera, observation_errors
from colmap_av1.geometry.triangulation import Observations, TriangulatedPoints, Views, triangulate
from colmap_av1.geometry.undistortion import Undistortion
from colmap_av1.options import TrackOptions, TriangulateOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Floats, Ints, Picture
from colmap_av1.util.grouping import groups, indices_in
from colmap_av1.util.progress import Progress, no_progress

# If a smaller share of the tracks agrees with the poses, the model is not of the same video.
LEAST_AGREEING = 0.5
# Smallest number of frames of a track that may give a point. With sufficient parallax, points from
# three frames are as accurate as points from four or five.
_TRACK_LENGTH = 3
# Luma weights of red, green and blue (BT.601), in thousandths.
_LUMA = np.array([299, 587, 114])
# Width in pixels of the squares with at most one track each. Tracks closer than this are assumed to
# follow the same point.
_CELL = 2
# Number of observations processed at a time, to limit memory.
_CHUNK = 1 << 18


def chaining_for_points(
    options: TrackOptions, triangulate: TriangulateOptions, *, is_downscaled: bool = False
) -> TrackOptions:
    """Options that give more tracks for points: shorter tracks, and tracks closer to each other.

    Args:
        options: options of the user; values that are None are set.
        triangulate: options with the smallest number of observations of a point.
        is_downscaled: whether motion is estimated in downscaled pictures and the tracks are
            corrected afterwards. The spacing is then not changed: motion blocks are already as
            fine as a trainer needs, and with more tracks, fewer of them would be corrected, in
            three times the time and with twice the memory.
    """
    if options.min_length is None:
        min_length = min(_TRACK_LENGTH, triangulate.min_observations)
        options = replace(options, min_length=min_length)
    if options.cell is None and not is_downscaled:
        options = replace(options, cell=min(_CELL, options.seeding))
    return options


def tracks_of_points(
    points: ModelPoints, frames: NDArray[np.int32], num_frames: int, size: tuple[int, int]
) -> Tracks:
    """The observations of a model's points as tracks, one for each point.

    Args:
        points: the points, each with at most one observation in an image.
        frames: int32 [num_images] the frame of each image.
        num_frames: number of frames of all videos.
        size: (width, height) of the largest image.
    """
    count = len(points.image)
    return Tracks(
        num_frames=num_frames,
        width=size[0],
        height=size[1],
        offsets=points.offsets,
        frame=frames[points.image],
        xy=points.xy.astype(np.float32),
        sigma=np.zeros(count, np.float32),
        confirmed=np.ones(count, np.bool_),
    )


@dataclass(frozen=True)
class TriangulatedTracks:
    """Tracks in some images, and the points triangulated from them.

    Attributes:
        tracks: the observations of the tracks in these images.
        view: int64 [num_observations] index of the image of each.
        rays: float64 [num_observations, 2] their undistorted positions, see `rays_of`.
        points: the points, with indices of these observations.
    """

    tracks: Tracks
    view: Ints
    rays: Floats
    points: TriangulatedPoints

    @property
    def agreement(self) -> float:
        """The share of the tracks that agree with the poses."""
        return self.points.num_agreeing / max(self.points.num_tracks, 1)

    def model_points(self, xy: Floats | None = None) -> ModelPoints:
        """The points as black model points.

        Args:
            xy: float64 [n, 2] the pixels of the points' observations; None: as in the tracks.
        """
        points, of_points = self.points, self.points.observation
        if xy is None:
            xy = self.tracks.xy[of_points].astype(np.float64)
        black = np.zeros((len(points.xyz), 3), np.uint8)
        image = self.view[of_points]
        return ModelPoints(points.xyz, black, points.error, points.offsets, image, xy)


def triangulate_tracks(
    tracks: Tracks,
    frames: NDArray[np.int32],
    views: Sequence[PosedCamera],
    *,
    options: TriangulateOptions,
    num_threads: int | None,
    pinholes: Sequence[pycolmap.Camera] | None = None,
    progress: Progress = no_progress,
) -> TriangulatedTracks:
    """Triangulate all tracks as `options.points` requests.

    Args:
        tracks: the tracks.
        frames: int32 [num_images] the frame of each image.
        views: the images, at least one.
        options: which points.
        num_threads: number of threads; None: one per CPU.
        pinholes: pinhole cameras in whose pixels errors are measured; None: pinhole cameras with
            the focal lengths of the images' own, see `fitting_in_images`.
        progress: called with the stage "points".
    """
    seen = tracks.keep_frames(frames)
    view = indices_in(frames, tracks.num_frames)[seen.frame].astype(np.int64)
    cameras = [own.camera for own in views]
    rays = rays_of(seen, view, cameras)
    shown = cameras if pinholes is None else pinholes
    focal = np.array([[c.focal_length_x, c.focal_length_y] for c in shown])
    points = (splat_points if options.points == "splats" else triangulate)(
        Observations(seen.offsets, view, rays, seen.sigma),
        Views(np.stack([own.cam_from_world for own in views]), focal),
        options,
        num_threads=num_threads,
        progress=lambda done: progress("points", done, seen.num_tracks),
    )
    return TriangulatedTracks(seen, view, rays, points)


def rays_of(tracks: Tracks, view: Ints, cameras: Sequence[pycolmap.Camera]) -> Floats:
    """Undistorted positions (x / z, y / z) of observations, float64 [num_observations, 2].

    Args:
        tracks: the tracks.
        view: int64 [num_observations] the image of each observation.
        cameras: the pycolmap.Camera of each image.
    """
    by_id = {int(camera.camera_id): camera for camera in cameras}
    camera_of_view = np.array([int(camera.camera_id) for camera in cameras])
    rays = np.empty(tracks.xy.shape)
    # Done in parts, because intermediate arrays are several times as large.
    for start in range(0, len(rays), _CHUNK):
        part = slice(start, start + _CHUNK)
        xy = tracks.xy[part].astype(np.float64)
        if len(by_id) == 1:
            rays[part] = cameras[0].cam_from_img(xy)
            continue
        camera_id = camera_of_view[view[part]]
        for own_id in np.unique(camera_id).tolist():
            own = camera_id == own_id
            rays[part][own] = by_id[own_id].cam_from_img(xy[own])
    return rays


class Colours:
    """Colours of points: for each point, the colour of median luma among its observations.

    The median is robust against single blurred, overexposed or occluded views. `sizes` gives the
    (width, height) of each image, in the pixels of the points' observations.
    """

    def __init__(self, points: ModelPoints, sizes: Sequence[tuple[int, int]]) -> None:
        self._points, self._sizes = points, np.array(sizes)
        self._by_image = groups(points.image, len(sizes))
        self._seen = np.zeros((len(points.image), 3), np.uint8)

    def add(self, image: int, picture: Picture, undistortion: Undistortion | None = None) -> None:
        """Sample the picture (BGR, of any scale) of an image.

        The picture has the camera of the model, after `undistortion` if given.
        """
        own = self._by_image[image]
        size = np.array(undistortion.size if undistortion is not None else picture.shape[1::-1])
        at = self._points.xy[own] * size / self._sizes[image]
        x, y = np.clip(at.astype(np.int64), 0, size - 1).T
        shown = undistortion.pixels(picture, x, y) if undistortion is not None else picture[y, x]
        self._seen[own] = shown[:, ::-1]

    def rgb(self) -> Picture:
        """Colours, uint8 [num_points, 3] RGB."""
        first, lengths = self._points.offsets[:-1], np.diff(self._points.offsets)
        most = int(lengths.max(initial=1))
        # Point, luma and observation index are packed in one key, because sorting by one key takes
        # a third of the time of sorting by several.
        key = self._points.point * (_LUMA.sum() * 255 + 1)
        key += self._seen.astype(np.int64) @ _LUMA
        key *= most
        key += np.arange(len(key)) - np.repeat(first, lengths)
        key.sort()
        return np.asarray(self._seen[first + key[first + lengths // 2] % most])


def mean_error(cloud: ModelPoints) -> float:
    """Mean reprojection error in pixels of the points whose error is known; NaN without any."""
    known = cloud.error[cloud.error >= 0]
    return float(known.mean()) if len(known) else math.nan


def fitting_in_images(
    points: ModelPoints, views: Sequence[PosedCamera], max_error: float
) -> ModelPoints:
    """The points that fit the images with their distortion, with their errors in them.

    Triangulation measures errors in pixels of a pinhole camera, which are wrong for rays that a
    fisheye lens receives from the side or from behind.

    Args:
        points: the points.
        views: the images, by the index that observations have.
        max_error: largest mean reprojection error in pixels.
    """
    lengths = np.diff(points.offsets)
    error = np.bincount(points.point, observation_errors(points, views), len(lengths)) / lengths
    return replace(points, error=error).take(np.flatnonzero(error <= max_error))
