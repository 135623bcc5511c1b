"""All tracks triangulated on known poses, with colours."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import ModelPoints
from colmap_av1.geometry.coverage import PosedCamera
from colmap_av1.geometry.distant_points import splat_points
from colmap_av1.geometry.triangulation import Observations, TriangulatedPoints, Views, triangulate
from colmap_av1.geometry.undistortion import Undistortion
from colmap_av1.options import TrackOptions, TriangulateOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.progress import Progress

_Image = NDArray[np.uint8]

# Share of the tracks that agree with the poses of a model of the same video, at least.
LEAST_AGREEING = 0.5
# Shown frames that a track is seen in at least which a point may come from: where rays meet at an
# angle, points of three frames are as true as those of four and five.
_TRACK_LENGTH = 3
# Weights of red, green and blue in what looks bright (BT.601), in thousandths.
_LUMA = np.array([299, 587, 114])
# Width in pixels of the squares that hold one track each: tracks that come near each other show
# two points as long as they do not come nearer than this.
_CELL = 2
# Observations worked on at a time; bounds memory.
_CHUNK = 1 << 18


def chaining_for_points(
    options: TrackOptions, triangulate: TriangulateOptions, *, is_downscaled: bool = False
) -> TrackOptions:
    """The options with more tracks, for points: short ones, and those that lie near another.

    Args:
        options: changed where they leave the choice.
        triangulate: how many observations a point has.
        is_downscaled: motion is searched in smaller pictures, whose tracks are corrected. There
            the squares of motion are as fine in them as a trainer needs points: more tracks would
            leave fewer of them corrected, at three times the time and twice the memory.
    """
    if options.min_length is None:
        min_length = min(_TRACK_LENGTH, triangulate.min_observations)
        options = replace(options, min_length=min_length)
    if options.cell is None and not is_downscaled:
        options = replace(options, cell=min(_CELL, options.seeding))
    return options


def seen_in(tracks: Tracks, frames: NDArray[np.int32]) -> tuple[Tracks, NDArray[np.int64]]:
    """The tracks in some frames only, and the index into `frames` of each observation."""
    place = np.full(tracks.num_frames, -1, dtype=np.int64)
    place[frames] = np.arange(len(frames))
    seen = tracks.keep_frames(frames)
    return seen, place[seen.frame]


def tracks_of_points(
    points: ModelPoints, frames: NDArray[np.int32], num_frames: int, size: tuple[int, int]
) -> Tracks:
    """The observations of a model's points as tracks, one for each point.

    Args:
        points: the points; an image sees each at most once.
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


def triangulate_tracks(
    tracks: Tracks,
    view: NDArray[np.int64],
    cameras: Sequence[pycolmap.Camera],
    poses: Sequence[NDArray[np.float64]],
    pinholes: Sequence[pycolmap.Camera] | None,
    *,
    options: TriangulateOptions,
    num_threads: int | None,
    progress: Progress,
    rays: NDArray[np.float64] | None = None,
) -> TriangulatedPoints:
    """Points of all tracks, of the kind that the options say.

    Errors are in pixels of each image's pinhole camera, else of its own. `rays` are those of
    `rays_of`, where these are known already.
    """
    rays = rays_of(tracks, view, cameras) if rays is None else rays
    shown = cameras if pinholes is None else pinholes
    focal = np.array([[c.focal_length_x, c.focal_length_y] for c in shown])
    num_tracks = tracks.num_tracks
    return (splat_points if options.points == "splats" else triangulate)(
        Observations(tracks.offsets, view, rays, tracks.sigma),
        Views(np.stack(poses), focal),
        options,
        num_threads=num_threads,
        progress=lambda done: progress("points", done, num_tracks),
    )


def rays_of(
    tracks: Tracks, view: NDArray[np.int64], cameras: Sequence[pycolmap.Camera]
) -> NDArray[np.float64]:
    """Undistorted positions (x / z, y / z) of observations, float64 [num_observations, 2].

    Args:
        tracks: the tracks.
        view: int64 [num_observations] the image of each observation.
        cameras: the pycolmap.Camera of each image.
    """
    by_id = {int(camera.camera_id): camera for camera in cameras}
    camera_of_view = np.array([int(camera.camera_id) for camera in cameras])
    rays = np.empty(tracks.xy.shape)
    # Part by part: what is made on the way is several times as large.
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
    """Colours of points as the middle one of the pictures shows them, picture by picture.

    A blurred, bright or hidden view among several does not change them. `sizes` are the (width,
    height) in pixels that each image has in the points.
    """

    def __init__(self, points: ModelPoints, sizes: Sequence[tuple[int, int]]) -> None:
        self._points, self._sizes = points, np.array(sizes)
        self._order = np.argsort(points.image, kind="stable")
        ordered = points.image[self._order]
        self._bounds = np.searchsorted(ordered, np.arange(len(sizes) + 1))
        self._seen = np.zeros((len(points.image), 3), np.uint8)

    def add(self, image: int, picture: _Image, undistortion: Undistortion | None = None) -> None:
        """Look at the picture (BGR, of any scale) of an image.

        It is of its model's camera, or what `undistortion` makes of it is.
        """
        own = self._order[self._bounds[image] : self._bounds[image + 1]]
        size = np.array(undistortion.size if undistortion is not None else picture.shape[1::-1])
        at = self._points.xy[own] * size / self._sizes[image]
        x, y = np.clip(at.astype(np.int64), 0, size - 1).T
        shown = undistortion.pixels(picture, x, y) if undistortion is not None else picture[y, x]
        self._seen[own] = shown[:, ::-1]

    def rgb(self) -> _Image:
        """Colours uint8 [num_points, 3], red first."""
        first, lengths = self._points.offsets[:-1], np.diff(self._points.offsets)
        most = int(lengths.max(initial=1))
        # Point, brightness and place among the point's in one number: sorting such takes a third
        # of the time of sorting by several.
        key = np.repeat(np.arange(len(lengths)), lengths) * (_LUMA.sum() * 255 + 1)
        key += self._seen.astype(np.int64) @ _LUMA
        key *= most
        key += np.arange(len(key)) - np.repeat(first, lengths)
        key.sort()
        return np.asarray(self._seen[first + key[first + lengths // 2] % most])


def mean_error(cloud: ModelPoints) -> float:
    """Mean reprojection error in pixels of the points that have one."""
    return float(cloud.error[cloud.error >= 0].mean())


def reprojection_errors(points: ModelPoints, views: Sequence[PosedCamera]) -> NDArray[np.float64]:
    """Mean reprojection errors [num_points] in pixels of the images, with their distortion.

    Args:
        points: the points.
        views: the images, by the index that observations have.
    """
    lengths = np.diff(points.offsets)
    owner = np.repeat(np.arange(len(lengths)), lengths)
    order = np.argsort(points.image, kind="stable")
    bounds = np.searchsorted(points.image[order], np.arange(len(views) + 1))
    apart = np.empty(len(points.image))
    for image, view in enumerate(views):
        own = order[bounds[image] : bounds[image + 1]]
        seen = points.xyz[owner[own]] @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
        at = np.asarray(view.camera.img_from_cam(seen)).reshape(-1, 2)
        apart[own] = np.linalg.norm(at - points.xy[own], axis=1)
    return np.bincount(owner, apart, len(lengths)) / lengths


def to_model_points(
    points: TriangulatedPoints, view: NDArray[np.int64], xy: NDArray[np.float64]
) -> ModelPoints:
    """The points as a model holds them, in black; `xy` are the pixels of their observations."""
    black = np.zeros((len(points.xyz), 3), np.uint8)
    return ModelPoints(
        points.xyz, black, points.error, points.offsets, view[points.observation], xy
    )
