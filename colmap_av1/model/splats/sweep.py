"""Points where no track is: what a picture shows there is looked for along its rays in others.

An encoder finds no motion of what is near and passes fast, of thin leaves, or of what only a few
frames show; such places would be filled as far away as what is around. With poses known the
pictures tell more: a patch of one is compared with those of the pictures before and after it at
all depths in turn (Collins, "A space-sweep approach to true multi-image matching", 1996).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.model.colmap_model import ModelPoints, joined_points, no_points
from colmap_av1.model.coverage import (
    CELL,
    PosedCamera,
    evenly_spread,
    nearest_in_cells,
    squares_of_cells,
)
from colmap_av1.model.splats.cloud import take_points

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

# Pictures are compared at the largest whole fraction of their size with at most so many pixels.
_MOST_PIXELS = 250_000
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
# Depths that are tried, at least and at most: one for each pixel that a patch moves by.
_DEPTHS = (16, 160)
# Width in pixels of the smaller picture of a square that is looked at, at least.
_LEAST_SQUARE = 4
# Standard deviation in grey values that a patch has at least.
_LEAST_DEVIATION = 6.0
# Pictures that a point is compared with, at least; the best of them count.
_LEAST_OTHERS = 2
# Correlation with the best two pictures, in the mean, and how much less the next best depth has
# that is not beside the best.
_LEAST_CORRELATION = 0.7
_MARGIN = 0.07
_BESIDE = 3
# Error in pixels of the smaller picture that a point has at most: where each picture by itself
# finds it is off by more, the depth that is best in the mean is often wrong.
_MOST_ERROR = 0.25
# A picture sees a point where it shows a patch that correlates at least so well.
_SEES = 0.6
# Others of the same image within so many pixels have a depth that differs by at most this factor.
_AROUND = 1.6 * CELL
_SAME_DEPTH = 1.15
# Of so many images before and after this share may show what is farther by this factor instead.
_HIDES_IN = 8
_HIDES = 1.25
_MAY_HIDE = 0.25
_CHUNK = 256


@dataclass(frozen=True)
class _Swept:
    """Points that one image found.

    Attributes:
        image: index of the image.
        xy: float64 [n, 2] its pixels.
        depth: float64 [n] along its camera's axis.
        others: the images that were compared with it.
        seen: float64 [m, n, 2] pixels where each of these shows it best; NaN where it does not.
    """

    image: int
    xy: _Floats
    depth: _Floats
    others: list[int]
    seen: _Floats

    def take(self, kept: NDArray[np.bool_]) -> _Swept:
        """Some of the points."""
        return _Swept(self.image, self.xy[kept], self.depth[kept], self.others, self.seen[:, kept])

    def xyz(self, view: PosedCamera) -> _Floats:
        """The points in the world."""
        own = view.rays(self.xy) * self.depth[:, None] - view.cam_from_world[:, 3]
        return np.asarray(own @ view.cam_from_world[:, :3])


def swept_points(
    points: ModelPoints,
    views: Sequence[PosedCamera],
    takes: NDArray[np.int32],
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    *,
    num_threads: int,
    progress: Callable[[int], None],
) -> ModelPoints:
    """Points in those cells of the images that no point of a track is seen in.

    A point is kept where pictures before or after show the same as clearly at no other depth, each
    by itself at nearly that depth, where one beside it is as far away, and where it hides nothing
    that tracks show.

    Args:
        points: points of tracks.
        views: the images, by the index that observations have.
        takes: int32 [num_images] the video of each image; pictures of one are compared.
        pictures: (image, uint8 BGR picture [height, width, 3]) in ascending order; those that are
            missing are not looked at.
        num_threads: threads that compare.
        progress: called after each picture with the number of pictures so far.

    Returns:
        The points, in black.
    """
    observed = _nearest_observed(points, views)
    keys = evenly_spread(len(views), min(-(-len(views) // _EVERY), _MOST_IMAGES))
    some = points.xyz[evenly_spread(len(points.xyz), _MOST_POINTS)]
    near = {key: _near_depth(views[key], some) for key in keys}
    others = {key: _others(key, near[key], views, takes) for key in keys}
    found = [no_points()]
    with ThreadPoolExecutor(num_threads) as threads:
        for key, greys in _with_others(others, pictures, progress):
            cells = np.isinf(observed[key]) & views[key].counting_cells
            xy = _squares(views[key], cells, greys[key].factor)
            swept = _sweep(views, key, greys, xy, near[key] * _NEARER, threads=threads)
            swept = swept.take(_is_supported(swept.xy, swept.depth))
            swept = swept.take(~_hides(swept, views, takes, observed))
            own = _as_points(swept, views)
            exact = own.error <= _MOST_ERROR * greys[key].factor
            found.append(take_points(own, np.flatnonzero(exact)))
    return joined_points(found)


@dataclass(frozen=True)
class _Grey:
    """A picture made smaller, by a factor."""

    pixels: NDArray[np.uint8]
    factor: int

    def place(self, xy: _Floats) -> NDArray[np.float32]:
        """Where pixels of the picture are in the smaller one."""
        return (xy / self.factor).astype(np.float32)


def _factor(size: tuple[int, int]) -> int:
    """How much smaller pictures of a (width, height) are made."""
    return math.ceil(math.sqrt(math.prod(size) / _MOST_PIXELS))


def _smaller(picture: NDArray[np.uint8]) -> _Grey:
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    factor = _factor(grey.shape[::-1])
    height, width = (length // factor for length in grey.shape)
    # Cut to whole squares, or all of it would be drawn closer by a fraction of a pixel.
    grey = np.ascontiguousarray(grey[: height * factor, : width * factor])
    if factor > 1:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    return _Grey(np.asarray(grey, np.uint8), factor)


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
    key: int, near: float, views: Sequence[PosedCamera], takes: NDArray[np.int32]
) -> list[int]:
    """The images that one is compared with: of its video, and apart enough to tell depths."""

    def there(steps: int) -> bool:
        return 0 <= key + steps < len(views) and takes[key + steps] == takes[key]

    def motion(image: int) -> float:
        focal = views[key].camera.mean_focal_length() / _factor(views[key].size)
        return float(np.linalg.norm(views[image].centre - views[key].centre) * focal / near)

    step = 1
    while step < _LONGEST_STEP and all(
        motion(key + way * step) < _NEAR_MOTION for way in (-1, 1) if there(way * step)
    ):
        step += 1
    return [key + number * step for number in _OTHERS if there(number * step)]


def _with_others(
    others: dict[int, list[int]],
    pictures: Iterable[tuple[int, NDArray[np.uint8]]],
    progress: Callable[[int], None],
) -> Iterator[tuple[int, dict[int, _Grey]]]:
    """Each image with its picture and those of the others, as soon as these are there."""
    left = sorted(others)
    greys: dict[int, _Grey] = {}
    for done, (index, picture) in enumerate(pictures, start=1):
        greys[index] = _smaller(picture)
        progress(done)
        while left and max([left[0], *others[left[0]]]) <= index:
            yield from _if_there(left.pop(0), others, greys)
        first = min((min([key, *others[key]]) for key in left), default=index)
        greys = {i: grey for i, grey in greys.items() if i >= first}
    for key in left:
        yield from _if_there(key, others, greys)


def _if_there(
    key: int, others: dict[int, list[int]], greys: dict[int, _Grey]
) -> Iterator[tuple[int, dict[int, _Grey]]]:
    there = {i: greys[i] for i in (key, *others[key]) if i in greys}
    if key in there and len(there) > _LEAST_OTHERS:
        yield key, there


def _squares(view: PosedCamera, cells: NDArray[np.bool_], factor: int) -> _Floats:
    """Centres in pixels of the squares of cells that are looked at, four or one in each."""
    rows, columns = np.nonzero(cells)
    per_cell = 2 if factor <= CELL // _LEAST_SQUARE // 2 else 1
    xy = squares_of_cells(rows, columns, per_cell)
    xy = xy[(xy < view.size).all(axis=1)]
    return xy[view.keeps(xy)]


def _sweep(
    views: Sequence[PosedCamera],
    key: int,
    greys: dict[int, _Grey],
    xy: _Floats,
    least_depth: float,
    *,
    threads: ThreadPoolExecutor,
) -> _Swept:
    """Those of an image's pixels that its other pictures show at one depth, and that depth."""
    view, grey = views[key], greys[key]
    others = [image for image in greys if image != key]
    # What is flat, or at the edge, cannot be compared.
    xy = xy[_correlate(grey, xy, grey, xy[:, None])[:, 0] > 0]
    focal = view.camera.mean_focal_length() / grey.factor
    apart = max(float(np.linalg.norm(views[i].centre - view.centre)) for i in others)
    count = int(np.clip(focal * apart / least_depth, *_DEPTHS))
    inverse = np.linspace(0.0, 1.0 / least_depth, count)

    def look(first: int) -> _Swept:
        own = xy[first : first + _CHUNK]
        rays = view.rays(own)
        found = np.stack(
            [
                _correlate(grey, own, greys[i], _seen_at(view, views[i], rays, inverse[None]))
                for i in others
            ]
        )
        mean = np.sort(found, axis=0)[-_LEAST_OTHERS:].mean(axis=0)
        best = mean.argmax(axis=1)
        clear = _is_clear(mean, best)
        rays, best, mean, found = rays[clear], best[clear], mean[clear], found[:, clear]
        depth = 1.0 / (_top(mean, best) * inverse[1])
        seen = []
        for image, by_one in zip(others, found, strict=True):
            step, sees = _own_best(by_one, best)
            at = _seen_at(view, views[image], rays, (step * inverse[1])[:, None])[:, 0]
            sees[sees] = views[image].keeps(at[sees])
            seen.append(np.where(sees[:, None], at, np.nan))
        return _Swept(key, own[clear], depth, others, np.stack(seen))

    parts = [look(0), *threads.map(look, range(_CHUNK, len(xy), _CHUNK))]
    return _Swept(
        *(key, np.concatenate([own.xy for own in parts])),
        *(np.concatenate([own.depth for own in parts]), others),
        np.concatenate([own.seen for own in parts], axis=1),
    )


def _correlate(one: _Grey, xy: _Floats, two: _Grey, at: _Floats) -> NDArray[np.float32]:
    """Correlations [n, d] of what is at pixels [n, 2] of an image, and at [n, d, 2] of another."""
    return _core.correlate_patches(
        *(one.pixels, one.place(xy), two.pixels, two.place(at)), min_deviation=_LEAST_DEVIATION
    )


def _seen_at(view: PosedCamera, other: PosedCamera, rays: _Floats, inverse: _Floats) -> _Floats:
    """Pixels [n, d, 2] of another image for rays [n, 3] at inverse depths [n or 1, d].

    They are NaN behind that image's camera.
    """
    turn = other.cam_from_world[:, :3] @ view.cam_from_world[:, :3].T
    way = other.cam_from_world[:, 3] - turn @ view.cam_from_world[:, 3]
    seen = (rays @ turn.T)[:, None] + inverse[..., None] * way
    seen[seen[..., 2] <= 0] = np.nan
    return np.asarray(other.camera.img_from_cam(seen.reshape(-1, 3))).reshape(*seen.shape[:2], 2)


def _is_clear(found: NDArray[np.float32], best: _Ints) -> NDArray[np.bool_]:
    """Whether the best step of each row is good, and none but those beside it about as good.

    The first step, which is endlessly far away, and the last do not count: what is best may lie
    beyond them.
    """
    score = np.take_along_axis(found, best[:, None], axis=1)
    beside = np.abs(np.arange(found.shape[1]) - best[:, None]) <= _BESIDE
    second = np.where(beside, -1.0, found).max(axis=1)
    inside = (best > 0) & (best < found.shape[1] - 1)
    is_clear = inside & (score[:, 0] >= _LEAST_CORRELATION) & (second < score[:, 0] - _MARGIN)
    return np.asarray(is_clear)


def _top(found: NDArray[np.float32], best: _Ints) -> _Floats:
    """The steps, with fractions, of the tops of parabolas through the best and those beside it."""
    beside = np.clip(best[:, None] + np.arange(-1, 2), 0, found.shape[1] - 1)
    left, middle, right = np.take_along_axis(found, beside, axis=1).astype(np.float64).T
    bend = left - 2 * middle + right
    is_top = (bend < 0) & (middle >= left) & (middle >= right)
    return np.asarray(
        best + np.where(is_top, 0.5 * (left - right) / np.where(is_top, bend, 1.0), 0.0)
    )


def _own_best(found: NDArray[np.float32], best: _Ints) -> tuple[_Floats, NDArray[np.bool_]]:
    """The step, near the best one of all pictures, that one picture finds best, and if it is good.

    Args:
        found: float32 [n, d] what this picture finds.
        best: int64 [n] the step that is best for all.
    """
    around = np.clip(best[:, None] + np.arange(-_BESIDE, _BESIDE + 1), 0, found.shape[1] - 1)
    own = np.take_along_axis(found, around, axis=1)
    rows = np.arange(len(best))
    where = own.argmax(axis=1)
    return _top(found, around[rows, where]), own[rows, where] >= _SEES


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
    swept: _Swept,
    views: Sequence[PosedCamera],
    takes: NDArray[np.int32],
    observed: Sequence[_Floats],
) -> NDArray[np.bool_]:
    """Whether points would hide what tracks show in the images before and after."""
    xyz = swept.xyz(views[swept.image])
    hides, seen = np.zeros(len(xyz)), np.zeros(len(xyz))
    first, last = swept.image - _HIDES_IN, swept.image + _HIDES_IN
    for image in range(max(first, 0), min(last, len(views) - 1) + 1):
        if image == swept.image or takes[image] != takes[swept.image]:
            continue
        index, xy, depth = views[image].project(xyz)
        column, row = (xy // CELL).astype(np.int64).T
        behind = observed[image][row, column]
        seen[index] += 1
        hides[index] += np.isfinite(behind) & (depth * _HIDES < behind)
    return np.asarray(hides > _MAY_HIDE * np.maximum(seen, 1))


def _as_points(swept: _Swept, views: Sequence[PosedCamera]) -> ModelPoints:
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
        *(xyz, np.zeros((len(xyz), 3), np.uint8), error),
        np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(xyz)))]).astype(np.int64),
        *(images[rows[own]], all_seen[rows[own], point]),
    )
