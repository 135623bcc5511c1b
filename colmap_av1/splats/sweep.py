"""Points in image areas without tracks, found by a space sweep in the pictures.

Encoders find no motion for close objects that pass fast, for thin leaves, or for objects that only
a few frames show. Without this step, such areas would be filled at the depth of their surroundings.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.coverage import CELL, nearest_in_cells, squares_of_cells, valid_cells
from colmap_av1.geometry.masks import make_mask
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.splats.ray_search import (
    LEAST_OTHERS,
    Grey,
    Swept,
    reduced_grey,
    reduction_factor,
    sweep_image,
)
from colmap_av1.util.arrays import Bools, Floats
from colmap_av1.util.grouping import groups
from colmap_av1.util.spread import evenly_spread

# Every second image is swept, but at most _MOST_IMAGES, evenly spread.
_EVERY = 2
_MOST_IMAGES = 128
# Each image is compared with the images at these numbers of steps. The step, in images, is large
# enough that near points move by _NEAR_MOTION pixels of the reduced picture, up to a limit.
_OTHERS = (-2, -1, 1, 2)
_NEAR_MOTION = 8.0
_LONGEST_STEP = 8
# The near depth of an image is this quantile of the depths of points; the smallest depth that is
# tried is this share of it.
_NEAREST = 0.005
_NEARER = 0.25
_MOST_POINTS = 20_000
# Smallest width, in pixels of the reduced picture, of the squares in which one pixel is swept.
_LEAST_SQUARE = 4
# Largest reprojection error of a point in pixels of the reduced picture. If the best positions of
# the individual pictures deviate more, the common depth is often wrong.
_MOST_ERROR = 0.25
# A point needs another point of the same image within this distance in pixels, whose depth differs
# by at most this factor.
_AROUND = 1.6 * CELL
_SAME_DEPTH = 1.15
# A point is a floater if more than the share _MAY_HIDE of this many images before and after it
# show, in the same place, a surface that is farther by the factor _HIDES.
_HIDES_IN = 8
_HIDES = 1.25
_MAY_HIDE = 0.25


class Sweep:
    """Finds points in the image cells without points of tracks.

    A point is kept if other pictures agree on a unique depth, both together and individually, if a
    neighbouring point has a similar depth, and if it does not hide points of tracks. Pictures are
    added one by one, and released as soon as they are no longer needed.

    Args:
        points: points of tracks.
        views: the images, which the points' observations refer to.
        sequence: int32 [num_images] sequence of each image; only pictures of the same sequence are
            compared.
        num_threads: number of threads, which run until the context is left.
    """

    def __init__(
        self,
        points: ModelPoints,
        views: Sequence[PosedCamera],
        sequence: NDArray[np.int32],
        *,
        num_threads: int,
    ) -> None:
        self._views, self._sequence = views, sequence
        self._observed = _nearest_observed(points, views)
        keys = evenly_spread(len(views), min(-(-len(views) // _EVERY), _MOST_IMAGES))
        some = points.xyz[evenly_spread(len(points.xyz), _MOST_POINTS)]
        self._near = {key: _near_depth(views[key], some) for key in keys}
        self._others = {key: _others(key, self._near[key], views, sequence) for key in keys}
        self._needed = {image for key in keys for image in (key, *self._others[key])}
        self._left = sorted(keys)
        self._greys: dict[int, Grey] = {}
        self._found: list[ModelPoints] = [ModelPoints.empty()]
        self._threads = ThreadPoolExecutor(num_threads)

    def __enter__(self) -> Sweep:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(cancel_futures=True)

    def add(self, image: int, picture: NDArray[np.uint8]) -> None:
        """Add the picture of an image, uint8 [height, width, 3] BGR, of the view's camera.

        Pictures must be added in ascending order of images; missing pictures are skipped.
        """
        if image in self._needed:
            self._greys[image] = reduced_grey(picture)
        while self._left and max([self._left[0], *self._others[self._left[0]]]) <= image:
            self._look(self._left.pop(0))
        first = min((min([key, *self._others[key]]) for key in self._left), default=image + 1)
        self._greys = {i: grey for i, grey in self._greys.items() if i >= first}

    def result(self) -> ModelPoints:
        """The points, in black. Call this after all pictures have been added."""
        for key in self._left:
            self._look(key)
        self._left = []
        return ModelPoints.concatenate(self._found)

    def _look(self, key: int) -> None:
        """Sweep an image, if its picture and enough of the others were added."""
        greys = {i: self._greys[i] for i in (key, *self._others[key]) if i in self._greys}
        if key not in greys or len(greys) <= LEAST_OTHERS:
            return
        view, views = self._views[key], self._views
        cells = np.isinf(self._observed[key]) & _away_from_masks(view)
        xy = _squares(view, cells, greys[key].factor)
        nearest = self._near[key] * _NEARER
        swept = sweep_image(views, key, greys, xy, nearest, threads=self._threads)
        swept = swept.take(_is_supported(swept.xy, swept.depth))
        swept = swept.take(~_hides(swept, views, self._sequence, self._observed))
        own = _as_points(swept, views)
        exact = own.error <= _MOST_ERROR * greys[key].factor
        self._found.append(own.take(np.flatnonzero(exact)))


def _nearest_observed(points: ModelPoints, views: Sequence[PosedCamera]) -> list[Floats]:
    """Depth of the nearest observed point in each cell of each image; inf without one."""
    owner = points.point
    grids = []
    for view, own in zip(views, groups(points.image, len(views)), strict=True):
        axis = view.cam_from_world[2]
        depth = points.xyz[owner[own]] @ axis[:3] + axis[3]
        grids.append(nearest_in_cells(view.size, points.xy[own], depth))
    return grids


def _near_depth(view: PosedCamera, xyz: Floats) -> float:
    """Depth of the nearest points in front of a camera, in its picture or not; inf without any."""
    depth = xyz @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
    depth = depth[depth > 0]
    return float(np.quantile(depth, _NEAREST)) if len(depth) else math.inf


def _others(
    key: int, near: float, views: Sequence[PosedCamera], sequence: NDArray[np.int32]
) -> list[int]:
    """The images that one is compared with: of the same sequence, with a sufficient baseline."""

    def there(steps: int) -> bool:
        return 0 <= key + steps < len(views) and sequence[key + steps] == sequence[key]

    def motion(image: int) -> float:
        focal = views[key].camera.mean_focal_length() / reduction_factor(views[key].size)
        return float(np.linalg.norm(views[image].centre - views[key].centre) * focal / near)

    step = 1
    while step < _LONGEST_STEP and all(
        motion(key + way * step) < _NEAR_MOTION for way in (-1, 1) if there(way * step)
    ):
        step += 1
    return [key + number * step for number in _OTHERS if there(number * step)]


def _away_from_masks(view: PosedCamera) -> Bools:
    """The cells of an image without masked pixels in them or in adjacent cells.

    Masked objects are mostly dynamic and move little between pictures. At their edges, pictures
    would agree on a wrong depth.
    """
    from scipy.ndimage import binary_dilation  # noqa: PLC0415 - slow to import

    if view.mask is None:
        return valid_cells(view)
    masked = valid_cells(replace(view, mask=make_mask(~view.mask.kept)))
    return np.asarray(~binary_dilation(masked, np.ones((3, 3))))


def _squares(view: PosedCamera, cells: Bools, factor: int) -> Floats:
    """Centres in pixels of the squares to sweep, four or one in each cell."""
    rows, columns = np.nonzero(cells)
    per_cell = 2 if factor <= CELL // _LEAST_SQUARE // 2 else 1
    xy = squares_of_cells(rows, columns, per_cell)
    xy = xy[(xy < view.size).all(axis=1)]
    return xy[view.keeps(xy)]


def _is_supported(xy: Floats, depth: Floats) -> Bools:
    """Whether each point has a nearby point of similar depth."""
    from scipy.spatial import KDTree  # noqa: PLC0415 - slow to import

    supported = np.zeros(len(xy), np.bool_)
    pairs = KDTree(xy).query_pairs(_AROUND, output_type="ndarray") if len(xy) else None
    if pairs is not None:
        one, two = np.log(depth[pairs.T])
        supported[pairs[np.abs(one - two) <= math.log(_SAME_DEPTH)]] = True
    return supported


def _hides(
    swept: Swept,
    views: Sequence[PosedCamera],
    sequence: NDArray[np.int32],
    observed: Sequence[Floats],
) -> Bools:
    """Whether points would hide points of tracks in the images before and after."""
    xyz = swept.xyz(views[swept.image])
    hides, seen = np.zeros(len(xyz)), np.zeros(len(xyz))
    first, last = swept.image - _HIDES_IN, swept.image + _HIDES_IN
    for image in range(max(first, 0), min(last, len(views) - 1) + 1):
        if image == swept.image or sequence[image] != sequence[swept.image]:
            continue
        index, xy, depth = views[image].project(xyz)
        column, row = (xy // CELL).astype(np.int64).T
        behind = observed[image][row, column]
        seen[index] += 1
        hides[index] += np.isfinite(behind) & (depth * _HIDES < behind)
    return np.asarray(hides > _MAY_HIDE * np.maximum(seen, 1))


def _as_points(swept: Swept, views: Sequence[PosedCamera]) -> ModelPoints:
    """Convert points to model points with observations, in black."""
    xyz = swept.xyz(views[swept.image])
    all_seen = np.concatenate([swept.xy[None], swept.seen])
    images = np.array([swept.image, *swept.others])
    apart = np.zeros(all_seen.shape[:2])
    for row, image in enumerate(images.tolist()):
        expected = views[image].pixels(views[image].in_camera(xyz))
        apart[row] = np.linalg.norm(all_seen[row] - expected, axis=1)
    # Ordered by point, then by image.
    rows = np.argsort(images)
    sees = np.isfinite(apart[rows]).T
    error = np.nansum(apart, axis=0) / sees.sum(axis=1)
    point, own = np.nonzero(sees)
    return ModelPoints(
        xyz,
        np.zeros((len(xyz), 3), np.uint8),
        error,
        np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(xyz)))]).astype(np.int64),
        images[rows[own]],
        all_seen[rows[own], point],
    )
