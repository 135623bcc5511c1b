"""Corners found again in every image that shows their place, by the picture around each.

A corner that is followed from picture to picture drifts, and is lost where something hides it or
the camera looks away. Once it is a point in space, and poses are nearly right, its place in any
image is known to a pixel or two, and so is how the picture around it changes by the view: what one
image shows is looked for in all others, as patches are by Furukawa and Ponce ("Accurate, Dense, and
Robust Multi-View Stereopsis", 2010). All positions are then against one picture, and places seen
again share points with what was seen before.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.geometry.coverage import PosedCamera
from colmap_av1.geometry.triangulation import TriangulatedPoints
from colmap_av1.poses.corners.grey_pictures import GreyPictures
from colmap_av1.poses.corners.slopes import surface_slopes
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]
_Indices = NDArray[np.int64]
_Grey = NDArray[np.uint8]

# Width in pixels of what another image is to show around a point, the window that is compared and
# some around it, and of what is kept of the image that shows it.
_SHOWN = 17
_KEPT = 37
# Cosine of the angle between two views of a point, and factor by which what is around it grows,
# beyond which it looks too different.
_LEAST_COSINE = float(np.cos(np.radians(40.0)))
_MOST_GROWTH = 2.0
# Pixels by which a point may lie off its expected place, and by which the way there and back may
# miss its start.
_MAX_MOVE = 4.0
_MAX_RETURN = 0.15
# Normalised correlation of windows that show the same, at least.
_LEAST_LIKENESS = 0.8
# Pixels over which it is measured how a picture changes by the view.
_REACH = 4.0
# Points that are looked for in an image, evenly spread over all; bounds the time of long videos.
_MOST_POINTS = 1000
# Points of an image, below which it keeps those that were followed: what held it is not let go.
_FEW = 50
# Images that see a corner at least.
_LEAST_IMAGES = 3


@dataclass(frozen=True)
class _Patches:
    """Points, and the pictures around them.

    Attributes:
        xyz: float64 [n, 3] the points.
        image: int64 [n] the image that shows what is looked for.
        ray: float64 [n, 3] unit vectors from there to them.
        surface: float64 [n, 3, 3] three points of the surface around each: in that image they are
            seen at its place, `_REACH` pixels right of it, and below it.
        grey: uint8 [n, _KEPT, _KEPT] the picture around it there.
        fraction: float64 [n, 2] by how much its place lies off the middle of the middle pixel.
    """

    xyz: _Floats
    image: _Indices
    ray: _Floats
    surface: _Floats
    grey: _Grey
    fraction: _Floats


def found_again(
    corners: Tracks,
    view: _Indices,
    points: TriangulatedPoints,
    *,
    views: Sequence[PosedCamera],
    frames: NDArray[np.int32],
    pictures: GreyPictures,
    progress: Callable[[int], None],
) -> Tracks:
    """Corners where all images show them that have a picture.

    Args:
        corners: corners as tracks, in pixels of the images.
        view: int64 [num_observations] image of each of their observations.
        points: their points.
        views: all images, with their poses and what of them counts.
        frames: int32 [n] their frames.
        pictures: the grey pictures of images, which may be smaller than these.
        progress: called with the number of images so far.

    Returns:
        A track for each point that three images show: the observation in the middle of those it
        comes from, and where others show the same. In images where few are found it keeps what
        was followed.
    """
    point = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    image, xy = view[points.observation], corners.xy[points.observation].astype(np.float64)
    middle = (points.offsets[:-1] + points.offsets[1:]) // 2
    by_image = np.argsort(image, kind="stable")
    bounds = np.searchsorted(image[by_image], np.arange(len(views) + 1))
    patches = _cut(points, middle, image, xy, views=views, pictures=pictures)
    found = [(np.arange(len(points.xyz)), image[middle], xy[middle])]
    for number in range(len(views)):
        followed = by_image[bounds[number] : bounds[number + 1]]
        own, at = point[followed], xy[followed]
        if number in pictures:
            seen, where = _found_in(number, patches, views[number], pictures, followed=own, at=at)
            if len(seen) < _FEW:
                left = ~np.isin(own, seen) & (patches.image[own] != number)
                seen, where = np.append(seen, own[left]), np.append(where, at[left], axis=0)
            found.append((seen, np.full(len(seen), number), where))
        progress(number + 1)
    columns = (np.concatenate(column) for column in zip(*found, strict=True))
    return _as_tracks(corners, frames, *columns)


def _as_tracks(
    corners: Tracks, frames: NDArray[np.int32], point: _Indices, image: _Indices, xy: _Floats
) -> Tracks:
    """Observations of points by images as tracks, of those that enough images see."""
    lengths = np.bincount(point, minlength=1)
    order = np.lexsort((image, point))
    order = order[lengths[point[order]] >= _LEAST_IMAGES]
    lengths = lengths[lengths >= _LEAST_IMAGES]
    return replace(
        corners,
        offsets=np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64),
        frame=frames[image[order]],
        xy=xy[order].astype(np.float32),
        sigma=np.full(len(order), corners.sigma.max(initial=0.0), np.float32),
        confirmed=np.ones(len(order), np.bool_),
    )


def _cut(
    points: TriangulatedPoints,
    middle: _Indices,
    image: _Indices,
    xy: _Floats,
    *,
    views: Sequence[PosedCamera],
    pictures: GreyPictures,
) -> _Patches:
    """Cut out the pictures around points.

    Args:
        points: the points.
        middle: int64 [n] the observation of each at which it is cut out.
        image: int64 [num_observations] image of each of their observations.
        xy: float64 [num_observations, 2] pixels of these.
        views: all images.
        pictures: their pictures.
    """
    xyz, point = points.xyz, np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    grey = np.empty((len(xyz), _KEPT, _KEPT), np.uint8)
    fraction, ray = np.empty((len(xyz), 2)), np.empty((len(xyz), 3))
    surface = np.empty((len(xyz), 3, 3))
    half, offset = _KEPT // 2, np.arange(_KEPT)
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
        for k, reach in enumerate(np.array([[0, 0], [_REACH, 0], [0, _REACH]])):
            far = (depth[own] / (1 + slope @ reach))[:, None]
            surface[own, k] = (view.rays(xy[middle[own]] + reach * scale) * far - shift) @ rotation
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    return _Patches(xyz, image[middle], ray, surface, grey, fraction)


def _scale(view: PosedCamera, size: tuple[int, int]) -> _Floats:
    """Pixels of an image, along x and y, to one of its picture of a (width, height)."""
    return np.array(view.size) / size


def _found_in(
    number: int,
    patches: _Patches,
    view: PosedCamera,
    pictures: GreyPictures,
    *,
    followed: _Indices,
    at: _Floats,
) -> tuple[_Indices, _Floats]:
    """The points that an image shows as another does.

    Args:
        number: the image.
        patches: the points.
        view: its camera and pose, and what of it counts.
        pictures: the grey pictures.
        followed: int64 [k] points that were followed into it.
        at: float64 [k, 2] their pixels; others are looked for where their poses place them.

    Returns:
        int64 [m] the points, and float64 [m, 2] their pixels.
    """
    size = pictures.size(number)
    scale = _scale(view, size)
    index, expected, change = _in_view(number, patches, view, size)
    if len(index) == 0:
        return index, expected
    place = np.full(len(patches.xyz), -1)
    place[followed] = np.arange(len(followed))
    seen = place[index] >= 0
    expected[seen] = at[place[index[seen]]] / scale
    grey = pictures.read(number)
    found, missed, likeness = _core.find_patches(
        patches.grey,
        index,
        middle=patches.fraction[index].astype(np.float32),
        change=change.astype(np.float32),
        target=grey,
        start=expected.astype(np.float32),
        max_move=_MAX_MOVE,
    )
    sure = (missed <= _MAX_RETURN) & (likeness >= _LEAST_LIKENESS)
    margin = _SHOWN // 2
    sure &= ((found >= margin) & (found < np.array(size) - margin)).all(axis=1)
    xy = found * scale
    sure[sure] = view.keeps(xy[sure])
    return index[sure], xy[sure]


def _in_view(
    number: int, patches: _Patches, view: PosedCamera, size: tuple[int, int]
) -> tuple[_Indices, _Floats, _Floats]:
    """The points that an image should show much as another does.

    Args:
        number: the image.
        patches: the points.
        view: its camera and pose.
        size: (width, height) of its picture.

    Returns:
        int64 [m] the points; float64 [m, 2] their places in the picture; float64 [m, 2, 2] how the
        one around them changes: pixels (x, y) of theirs to one of this along x, and along y.
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
    growth = np.stack([xy[:, 1] - xy[:, 0], xy[:, 2] - xy[:, 0]], axis=-1) / _REACH
    area = np.linalg.det(growth)
    kept = (area > 0) & (area <= _MOST_GROWTH**2) & _near_views(patches, index, view)
    margin = _SHOWN // 2
    kept &= ((xy[:, 0] >= margin) & (xy[:, 0] <= np.array(size) - margin)).all(axis=1)
    index, at, change = index[kept], xy[kept, 0], np.linalg.inv(growth[kept])
    # What is kept of the picture around covers what is to be shown of it.
    farthest = np.abs(change).sum(axis=2).max(axis=1, initial=0.0) * (_SHOWN // 2)
    kept = np.flatnonzero(farthest <= _KEPT // 2 - 1)
    kept = kept[evenly_spread(len(kept), _MOST_POINTS)] if len(kept) else kept
    return index[kept], at[kept], change[kept]


def _near_views(patches: _Patches, index: _Indices, view: PosedCamera) -> NDArray[np.bool_]:
    """Whether points are seen from much the same side as where their pictures were cut out."""
    ray = patches.xyz[index] - view.centre
    cosine = (patches.ray[index] * ray).sum(axis=1) / np.linalg.norm(ray, axis=1)
    return np.asarray(cosine >= _LEAST_COSINE)
