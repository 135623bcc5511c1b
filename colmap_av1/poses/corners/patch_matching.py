"""Patch matching of corners in every image that sees their points.

A corner that is followed from picture to picture drifts, and is lost where it is occluded or leaves
the picture. Its triangulated point and nearly correct poses predict its position in any image to a
pixel or two, and the deformation of the patch around it. The patch of one image is therefore
searched in all others, as Furukawa and Ponce do ("Accurate, Dense, and Robust Multi-View
Stereopsis", 2010). All positions then refer to one patch, so that nothing drifts, and images of a
revisited place observe the same points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.geometry.track_points import TriangulatedTracks
from colmap_av1.geometry.triangulation import TriangulatedPoints
from colmap_av1.poses.corners.grey_pictures import GreyPictures
from colmap_av1.poses.corners.slopes import surface_slopes
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Floats, Ints, Picture
from colmap_av1.util.grouping import groups, indices_in
from colmap_av1.util.spread import evenly_spread
from colmap_av1.util.threads import map_on_threads

# Width in pixels of the area around a point that the searched image must cover, which is the
# compared window with a margin, and of the patch that is cut out of the source image.
_WINDOW = 17
_PATCH = 37
# Largest viewing angle between the source image and the searched image, as a cosine, and largest
# magnification of the patch. Beyond them it looks too different.
_MIN_COSINE = float(np.cos(np.radians(40.0)))
_MAX_MAGNIFICATION = 2.0
# Largest distance in pixels of a match from its expected position, and largest forward-backward
# error.
_MAX_MOVE = 4.0
_MAX_RETURN = 0.15
# Smallest normalised correlation of a match.
_MIN_CORRELATION = 0.8
# Step in pixels over which the deformation of a patch is measured.
_STEP = 4.0
# Largest number of points searched in an image, evenly spread.
_MAX_POINTS = 1000
# An image with fewer matches than this keeps its followed corners, so that it does not lose its
# connection to the others.
_FEW = 50
# Smallest number of observations of a corner.
_MIN_IMAGES = 3


@dataclass(frozen=True)
class _Patches:
    """Points with the patches around them.

    Attributes:
        xyz: float64 [n, 3] the points.
        image: int64 [n] source image of each patch.
        ray: float64 [n, 3] unit vectors from the camera centre of the source image to the points.
        surface: float64 [n, 3, 3] three points on the surface at each point: in the source image
            they lie at its position, `_STEP` pixels to the right, and `_STEP` pixels below.
        grey: uint8 [n, _PATCH, _PATCH] the patches.
        fraction: float64 [n, 2] offset in pixels of the position from the centre of the middle
            pixel of the patch.
    """

    xyz: Floats
    image: Ints
    ray: Floats
    surface: Floats
    grey: Picture
    fraction: Floats


def match_patches(
    corners: TriangulatedTracks,
    *,
    views: Sequence[PosedCamera],
    frames: NDArray[np.int32],
    pictures: GreyPictures,
    num_threads: int | None,
    progress: Callable[[int], None],
) -> Tracks:
    """Locate corners in all images that have a picture.

    Args:
        corners: corners as tracks in pixels of the images, and their points.
        views: all images, with their poses and masks.
        frames: int32 [n] their frames.
        pictures: grey pictures of the images, which may be downscaled.
        num_threads: number of threads; None: one per CPU. The result does not depend on it.
        progress: called with the number of images so far.

    Returns:
        A track for each point with three or more observations: its middle observation, from which
        the patch is cut, and the matches in other images. Images with few matches keep the
        followed corners.
    """
    tracks, points = corners.tracks, corners.points
    point = points.point
    image = corners.view[points.observation]
    xy = tracks.xy[points.observation].astype(np.float64)
    middle = (points.offsets[:-1] + points.offsets[1:]) // 2
    by_image = groups(image, len(views))
    patches = _cut(points, middle, image, xy, views=views, pictures=pictures)
    found = [(np.arange(len(points.xyz)), image[middle], xy[middle])]

    def search(number: int) -> tuple[Ints, Ints, Floats]:
        followed = by_image[number]
        own, at = point[followed], xy[followed]
        if number not in pictures:
            return own[:0], own[:0], at[:0]
        seen, where = _found_in(number, patches, views[number], pictures, followed=own, at=at)
        if len(seen) < _FEW:
            left = ~np.isin(own, seen) & (patches.image[own] != number)
            seen, where = np.append(seen, own[left]), np.append(where, at[left], axis=0)
        return seen, np.full(len(seen), number), where

    searched = map_on_threads(search, range(len(views)), num_threads)
    for done, matches in enumerate(searched, start=1):
        found.append(matches)
        progress(done)
    own, image, at = (np.concatenate(column) for column in zip(*found, strict=True))
    return Tracks.from_observations(
        tracks.num_frames,
        (tracks.width, tracks.height),
        track=own,
        frame=frames[image],
        xy=at,
        sigma=float(tracks.sigma.max(initial=0.0)),
        min_length=_MIN_IMAGES,
    )


def _cut(
    points: TriangulatedPoints,
    middle: Ints,
    image: Ints,
    xy: Floats,
    *,
    views: Sequence[PosedCamera],
    pictures: GreyPictures,
) -> _Patches:
    """Cut out the patches around points.

    Args:
        points: the points.
        middle: int64 [n] the observation of each point at which its patch is cut out.
        image: int64 [num_observations] image of each observation.
        xy: float64 [num_observations, 2] its position in pixels.
        views: all images.
        pictures: their pictures.
    """
    xyz, point = points.xyz, points.point
    grey = np.empty((len(xyz), _PATCH, _PATCH), np.uint8)
    fraction, ray = np.empty((len(xyz), 2)), np.empty((len(xyz), 3))
    surface = np.empty((len(xyz), 3, 3))
    half, offset = _PATCH // 2, np.arange(_PATCH)
    for number in np.unique(image[middle]).tolist():
        own, view = np.flatnonzero(image[middle] == number), views[number]
        scale = _scale(view, pictures.size(number))
        at = xy[middle[own]] / scale
        corner = np.floor(at).astype(np.int64)
        fraction[own] = at - corner - 0.5
        framed = cv2.copyMakeBorder(
            pictures.read(number), half, half, half, half, cv2.BORDER_REPLICATE
        )
        x, y = (corner[:, k, None] + offset for k in (0, 1))
        grey[own] = framed[y[:, :, None], x[:, None, :]]
        ray[own] = xyz[own] - view.centre
        rotation, shift = view.cam_from_world[:, :3], view.cam_from_world[:, 3]
        depth = xyz @ rotation[2] + shift[2]
        shown = np.flatnonzero(image == number)
        slope = surface_slopes(at, depth[own], xy[shown] / scale, depth[point[shown]])
        for k, reach in enumerate(np.array([[0, 0], [_STEP, 0], [0, _STEP]])):
            far = (depth[own] / (1 + slope @ reach))[:, None]
            surface[own, k] = (view.rays(xy[middle[own]] + reach * scale) * far - shift) @ rotation
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return _Patches(xyz, image[middle], ray, surface, grey, fraction)


def _scale(view: PosedCamera, size: tuple[int, int]) -> Floats:
    """Size of an image over the (width, height) of its picture, along x and y."""
    return np.array(view.size) / size


def _found_in(
    number: int,
    patches: _Patches,
    view: PosedCamera,
    pictures: GreyPictures,
    *,
    followed: Ints,
    at: Floats,
) -> tuple[Ints, Floats]:
    """Search the patches of all points in an image.

    Args:
        number: the image.
        patches: the points.
        view: its camera, pose and mask.
        pictures: the grey pictures.
        followed: int64 [k] points whose corners were followed into the image.
        at: float64 [k, 2] their positions in pixels, where their search starts; the search for the
            others starts at their projections.

    Returns:
        int64 [m] the points found, and float64 [m, 2] their positions in pixels.
    """
    size = pictures.size(number)
    scale = _scale(view, size)
    index, expected, change = _in_view(number, patches, view, size)
    if len(index) == 0:
        return index, expected
    rank = indices_in(followed, len(patches.xyz))[index]
    seen = rank >= 0
    expected[seen] = at[rank[seen]] / scale
    grey = pictures.read(number)
    found, error, correlation = _core.find_patches(
        patches.grey,
        index,
        middle=patches.fraction[index].astype(np.float32),
        change=change.astype(np.float32),
        target=grey,
        start=expected.astype(np.float32),
        max_move=_MAX_MOVE,
    )
    sure = (error <= _MAX_RETURN) & (correlation >= _MIN_CORRELATION)
    margin = _WINDOW // 2
    sure &= ((found >= margin) & (found < np.array(size) - margin)).all(axis=1)
    xy = found * scale
    sure[sure] = view.keeps(xy[sure])
    return index[sure], xy[sure]


def _in_view(
    number: int, patches: _Patches, view: PosedCamera, size: tuple[int, int]
) -> tuple[Ints, Floats, Floats]:
    """The points whose patches should look much the same in an image.

    Args:
        number: the image.
        patches: the points.
        view: its camera and pose.
        size: (width, height) of its picture.

    Returns:
        int64 [m] the points; float64 [m, 2] their positions in the picture; float64 [m, 2, 2] the
        affine deformation of each patch: the columns are its pixels (x, y) per pixel of the
        picture along x and along y.
    """
    index, _, _ = view.project(patches.xyz)
    index = index[patches.image[index] != number]
    surface = patches.surface[index] @ view.cam_from_world[:, :3].T + view.cam_from_world[:, 3]
    ahead = (surface[:, :, 2] > 0).all(axis=1)
    index, surface = index[ahead], surface[ahead]
    if len(index) == 0:
        return index, np.empty((0, 2)), np.empty((0, 2, 2))
    xy = np.asarray(view.camera.img_from_cam(surface.reshape(-1, 3))).reshape(-1, 3, 2)
    xy /= _scale(view, size)
    growth = np.stack([xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]], axis=-1) / _STEP
    area = np.linalg.det(growth)
    kept = (area > 0) & (area <= _MAX_MAGNIFICATION**2) & _near_views(patches, index, view)
    margin = _WINDOW // 2
    kept &= ((xy[:, 0] >= margin) & (xy[:, 0] <= np.array(size) - margin)).all(axis=1)
    index, at, change = index[kept], xy[kept, 0], np.linalg.inv(growth[kept])
    # The patch must cover the window.
    farthest = np.abs(change).sum(axis=2).max(axis=1, initial=0.0) * (_WINDOW // 2)
    kept = np.flatnonzero(farthest <= _PATCH // 2 - 1)
    kept = kept[evenly_spread(len(kept), _MAX_POINTS)]
    return index[kept], at[kept], change[kept]


def _near_views(patches: _Patches, index: Ints, view: PosedCamera) -> Bools:
    """Whether the viewing angle between an image and the source of each patch is small enough."""
    ray = patches.xyz[index] - view.centre
    cosine = (patches.ray[index] * ray).sum(axis=1) / np.linalg.norm(ray, axis=1)
    return np.asarray(cosine >= _MIN_COSINE)
