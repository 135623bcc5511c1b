"""How far away what one picture shows is, by looking for it along its rays in others.

Patches are compared at all depths in turn (Collins, "A space-sweep approach to true multi-image
matching", 1996).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1 import _core
from colmap_av1.geometry.coverage import PosedCamera

_Floats = NDArray[np.float64]
_Ints = NDArray[np.int64]

# Pictures are compared at the largest whole fraction of their size with at most so many pixels.
_MOST_PIXELS = 250_000
# Depths that are tried, at least and at most: one for each pixel that a patch moves by.
_DEPTHS = (16, 160)
# Standard deviation in grey values that a patch has at least.
_LEAST_DEVIATION = 6.0
# Pictures that a point is compared with, at least; the best two of them count.
LEAST_OTHERS = 2
# Correlation with the best two pictures, in the mean, and how much less the next best depth has
# that is not beside the best.
_LEAST_CORRELATION = 0.7
_MARGIN = 0.07
_BESIDE = 3
# A picture sees a point where it shows a patch that correlates at least so well.
_SEES = 0.6
_CHUNK = 256


@dataclass(frozen=True)
class Swept:
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

    def take(self, kept: NDArray[np.bool_]) -> Swept:
        """Some of the points."""
        return Swept(self.image, self.xy[kept], self.depth[kept], self.others, self.seen[:, kept])

    def xyz(self, view: PosedCamera) -> _Floats:
        """The points in the world."""
        own = view.rays(self.xy) * self.depth[:, None] - view.cam_from_world[:, 3]
        return np.asarray(own @ view.cam_from_world[:, :3])


@dataclass(frozen=True)
class Grey:
    """A picture made smaller, by a factor."""

    pixels: NDArray[np.uint8]
    factor: int

    def place(self, xy: _Floats) -> NDArray[np.float32]:
        """Where pixels of the picture are in the smaller one."""
        return (xy / self.factor).astype(np.float32)


def shrinking(size: tuple[int, int]) -> int:
    """How much smaller pictures of a (width, height) are made."""
    return math.ceil(math.sqrt(math.prod(size) / _MOST_PIXELS))


def smaller(picture: NDArray[np.uint8]) -> Grey:
    """A picture, uint8 [height, width, 3] BGR, as it is compared."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    factor = shrinking(grey.shape[::-1])
    height, width = (length // factor for length in grey.shape)
    # Cut to whole squares, or all of it would be drawn closer by a fraction of a pixel.
    grey = np.ascontiguousarray(grey[: height * factor, : width * factor])
    if factor > 1:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    return Grey(np.asarray(grey, np.uint8), factor)


def sweep_image(
    views: Sequence[PosedCamera],
    key: int,
    greys: Mapping[int, Grey],
    xy: _Floats,
    least_depth: float,
    *,
    threads: Executor,
) -> Swept:
    """Those of an image's pixels that its other pictures show at one depth, and that depth.

    Args:
        views: the images.
        key: index of the image.
        greys: its picture and the others, by their indices.
        xy: float64 [n, 2] pixels of the image.
        least_depth: the nearest depth that is tried; the farthest is without end.
        threads: compare.
    """
    view, grey = views[key], greys[key]
    others = [image for image in greys if image != key]
    # What is flat, or at the edge, cannot be compared.
    xy = xy[_correlate(grey, xy, grey, xy[:, None])[:, 0] > 0]
    focal = view.camera.mean_focal_length() / grey.factor
    apart = max(float(np.linalg.norm(views[i].centre - view.centre)) for i in others)
    count = int(np.clip(focal * apart / least_depth, *_DEPTHS))
    inverse = np.linspace(0.0, 1.0 / least_depth, count)

    def look(first: int) -> Swept:
        own = xy[first : first + _CHUNK]
        rays = view.rays(own)
        found = np.stack(
            [
                _correlate(grey, own, greys[i], _seen_at(view, views[i], rays, inverse[None]))
                for i in others
            ]
        )
        mean = _mean_of_best(found)
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
        return Swept(key, own[clear], depth, others, np.stack(seen))

    parts = [look(0), *threads.map(look, range(_CHUNK, len(xy), _CHUNK))]
    return Swept(
        key,
        np.concatenate([own.xy for own in parts]),
        np.concatenate([own.depth for own in parts]),
        others,
        np.concatenate([own.seen for own in parts], axis=1),
    )


def _correlate(one: Grey, xy: _Floats, two: Grey, at: _Floats) -> NDArray[np.float32]:
    """Correlations [n, d] of what is at pixels [n, 2] of an image, and at [n, d, 2] of another."""
    return _core.correlate_patches(
        one.pixels, one.place(xy), two.pixels, two.place(at), min_deviation=_LEAST_DEVIATION
    )


def _seen_at(view: PosedCamera, other: PosedCamera, rays: _Floats, inverse: _Floats) -> _Floats:
    """Pixels [n, d, 2] of another image for rays [n, 3] at inverse depths [n or 1, d].

    They are NaN behind that image's camera.
    """
    turn = other.cam_from_world[:, :3] @ view.cam_from_world[:, :3].T
    way = other.cam_from_world[:, 3] - turn @ view.cam_from_world[:, 3]
    # By coordinates: NumPy's loops over rows of three take several times as long.
    seen = (turn @ rays.T)[:, :, None] + way[:, None, None] * inverse
    seen[:, seen[2] <= 0] = np.nan
    at = np.asarray(other.camera.img_from_cam(seen.reshape(3, -1).T))
    return at.reshape(*seen.shape[1:], 2)


def _mean_of_best(found: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of the best two along the first axis, which is short: sorting it takes far longer."""
    best, second = np.maximum(*found[:2]), np.minimum(*found[:2])
    for other in found[2:]:
        np.maximum(second, np.minimum(best, other), out=second)
        np.maximum(best, other, out=best)
    return np.asarray((best + second) / 2)


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
