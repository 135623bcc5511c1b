"""Points where no track is: what a picture shows there is looked for along its rays in others.

An encoder finds no motion of what is near and passes fast, of thin leaves, or of what only a few
frames show; such places would be filled as far away as what is around. With poses known the
pictures tell more.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import ModelPoints, joined_points, no_points
from colmap_av1.geometry.coverage import (
    CELL,
    PosedCamera,
    nearest_in_cells,
    squares_of_cells,
)
from colmap_av1.geometry.masks import make_mask
from colmap_av1.splats.cloud import take_points
from colmap_av1.splats.ray_search import (
    LEAST_OTHERS,
    Grey,
    Swept,
    shrinking,
    smaller,
    sweep_image,
)
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

# Images that are looked at: every so many-th, and at most.
_EVERY = 2
_MOST_IMAGES = 128
# The pictures that each is compared with, by how many steps they come after it. Steps are as long
# as makes what is near move by so many pixels of the smaller picture, and at most so many images.
_OTHERS = (-2, -1, 1, 2)
_NEAR_MOTION = 8.0
_LONGEST_STEP = 8
# What is near is nearer than all but this share of the points; this share of that is tried at most.
_NEAREST = 0.005
_NEARER = 0.25
_MOST_POINTS = 20_000
# Width in pixels of the smaller picture of a square that is looked at, at least.
_LEAST_SQUARE = 4
# Error in pixels of the smaller picture that a point has at most: where each picture by itself
# finds it is off by more, the depth that is best in the mean is often wrong.
_MOST_ERROR = 0.25
# Others of the same image within so many pixels have a depth that differs by at most this factor.
_AROUND = 1.6 * CELL
_SAME_DEPTH = 1.15
# Of so many images before and after this share may show what is farther by this factor instead.
_HIDES_IN = 8
_HIDES = 1.25
_MAY_HIDE = 0.25


class Sweep:
    """Looks for points in those cells of the images that no point of a track is seen in.

    A point is kept where pictures before or after show the same as clearly at no other depth, each
    by itself at nearly that depth, where one beside it is as far away, and where it hides nothing
    that tracks show. Pictures are given one by one, and let go as soon as no other needs them.

    Args:
        points: points of tracks.
        views: the images, by the index that observations have.
        sequence: int32 [num_images] sequence of each image; pictures of one are compared.
        num_threads: threads that compare; they are there as long as the context.
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
        self._found: list[ModelPoints] = [no_points()]
        self._threads = ThreadPoolExecutor(num_threads)

    def __enter__(self) -> Sweep:
        return self

    def __exit__(self, *_: object) -> None:
        self._threads.shutdown(cancel_futures=True)

    def add(self, image: int, picture: NDArray[np.uint8]) -> None:
        """Look at the picture of an image, uint8 [height, width, 3] BGR, as its camera says.

        They come in ascending order; those that are missing are not looked at.
        """
        if image in self._needed:
            self._greys[image] = smaller(picture)
        while self._left and max([self._left[0], *self._others[self._left[0]]]) <= image:
            self._look(self._left.pop(0))
        first = min((min([key, *self._others[key]]) for key in self._left), default=image + 1)
        self._greys = {i: grey for i, grey in self._greys.items() if i >= first}

    def result(self) -> ModelPoints:
        """The points, in black; all pictures that there are have been added."""
        for key in self._left:
            self._look(key)
        self._left = []
        return joined_points(self._found)

    def _look(self, key: int) -> None:
        """Find the points of an image, where its picture and enough of the others are there."""
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
        self._found.append(take_points(own, np.flatnonzero(exact)))


def _nearest_observed(points: ModelPoints, views: Sequence[PosedCamera]) -> list[_Floats]:
    """Depth of the nearest point that is seen in each cell of each image; inf where none is."""
    owner = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    by_image = np.argsort(points.image, kind="stable")
    bounds = np.searchsorted(points.image[by_image], np.arange(len(views) + 1))
    grids = []
    for image, view in enumerate(views):
        own = by_image[bounds[image] : bounds[image + 1]]
        axis = view.cam_from_world[2]
        depth = points.xyz[owner[own]] @ axis[:3] + axis[3]
        grids.append(nearest_in_cells(view.size, points.xy[own], depth))
    return grids


def _near_depth(view: PosedCamera, xyz: _Floats) -> float:
    """Depth of what is near a camera, in its picture or beside it; inf where nothing is."""
    depth = xyz @ view.cam_from_world[2, :3] + view.cam_from_world[2, 3]
    depth = depth[depth > 0]
    return float(np.quantile(depth, _NEAREST)) if len(depth) else math.inf


def _others(
    key: int, near: float, views: Sequence[PosedCamera], sequence: NDArray[np.int32]
) -> list[int]:
    """The images that one is compared with: of its video, and apart enough to tell depths."""

    def there(steps: int) -> bool:
        return 0 <= key + steps < len(views) and sequence[key + steps] == sequence[key]

    def motion(image: int) -> float:
        focal = views[key].camera.mean_focal_length() / shrinking(views[key].size)
        return float(np.linalg.norm(views[image].centre - views[key].centre) * focal / near)

    step = 1
    while step < _LONGEST_STEP and all(
        motion(key + way * step) < _NEAR_MOTION for way in (-1, 1) if there(way * step)
    ):
        step += 1
    return [key + number * step for number in _OTHERS if there(number * step)]


def _away_from_masks(view: PosedCamera) -> NDArray[np.bool_]:
    """The cells of an image that no masked pixel is in or beside.

    What a mask leaves out moves, as a rule, and moves by little from one picture to the next: where
    its edge shows, these agree on a depth that it does not have.
    """
    from scipy.ndimage import binary_dilation  # noqa: PLC0415 - slow to import

    if view.mask is None:
        return view.counting_cells
    left_out = replace(view, mask=make_mask(~view.mask.kept)).counting_cells
    return np.asarray(~binary_dilation(left_out, np.ones((3, 3))))


def _squares(view: PosedCamera, cells: NDArray[np.bool_], factor: int) -> _Floats:
    """Centres in pixels of the squares of cells that are looked at, four or one in each."""
    rows, columns = np.nonzero(cells)
    per_cell = 2 if factor <= CELL // _LEAST_SQUARE // 2 else 1
    xy = squares_of_cells(rows, columns, per_cell)
    xy = xy[(xy < view.size).all(axis=1)]
    return xy[view.keeps(xy)]


def _is_supported(xy: _Floats, depth: _Floats) -> NDArray[np.bool_]:
    """Whether another one around has the same depth."""
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
    observed: Sequence[_Floats],
) -> NDArray[np.bool_]:
    """Whether points would hide what tracks show in the images before and after."""
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
    """The points with their observations, in black."""
    xyz = swept.xyz(views[swept.image])
    all_seen = np.concatenate([swept.xy[None], swept.seen])
    images = np.array([swept.image, *swept.others])
    apart = np.zeros(all_seen.shape[:2])
    for row, image in enumerate(images.tolist()):
        pose = views[image].cam_from_world
        expected = views[image].camera.img_from_cam(xyz @ pose[:, :3].T + pose[:, 3])
        apart[row] = np.linalg.norm(all_seen[row] - np.reshape(expected, (-1, 2)), axis=1)
    # By points, and within these by images.
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
