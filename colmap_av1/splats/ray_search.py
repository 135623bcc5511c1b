"""Depths of pixels by a space sweep: patches are compared with other pictures at many depths.

Collins, "A space-sweep approach to true multi-image matching", 1996.
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
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.util.arrays import Bools, Floats, Ints

# Pictures are reduced by an integer factor to at most this number of pixels.
_MOST_PIXELS = 250_000
# Smallest and largest number of depths that are tried; in between one for each pixel of parallax.
_DEPTHS = (16, 160)
# Smallest standard deviation of a patch in grey values; flatter patches cannot be compared.
_LEAST_DEVIATION = 6.0
# Smallest number of other pictures; the mean of the best two correlations counts.
LEAST_OTHERS = 2
# Smallest mean correlation with the best two pictures, and its margin over all depths that are more
# than _BESIDE steps away.
_LEAST_CORRELATION = 0.7
_MARGIN = 0.07
_BESIDE = 3
# Smallest correlation at which another picture counts as observing a point.
_SEES = 0.6
_CHUNK = 256


@dataclass(frozen=True)
class Swept:
    """Points found by the sweep of one image.

    Attributes:
        image: index of the image.
        xy: float64 [n, 2] pixels of the points.
        depth: float64 [n] depths along the optical axis.
        others: indices of the m images that were compared with it.
        seen: float64 [m, n, 2] pixels with the best correlation in each of these; NaN for images
            that do not observe the point.
    """

    image: int
    xy: Floats
    depth: Floats
    others: list[int]
    seen: Floats

    def take(self, kept: Bools) -> Swept:
        """Select points."""
        return Swept(self.image, self.xy[kept], self.depth[kept], self.others, self.seen[:, kept])

    def xyz(self, view: PosedCamera) -> Floats:
        """The points in the world."""
        own = view.rays(self.xy) * self.depth[:, None] - view.cam_from_world[:, 3]
        return np.asarray(own @ view.cam_from_world[:, :3])


@dataclass(frozen=True)
class Grey:
    """A grey picture reduced by a factor."""

    pixels: NDArray[np.uint8]
    factor: int

    def place(self, xy: Floats) -> NDArray[np.float32]:
        """Convert pixels of the picture to pixels of the reduced picture."""
        return (xy / self.factor).astype(np.float32)


def reduction_factor(size: tuple[int, int]) -> int:
    """The factor by which pictures of a (width, height) are reduced."""
    return math.ceil(math.sqrt(math.prod(size) / _MOST_PIXELS))


def reduced_grey(picture: NDArray[np.uint8]) -> Grey:
    """Convert a picture, uint8 [height, width, 3] BGR, to a reduced grey picture."""
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    factor = reduction_factor(grey.shape[::-1])
    height, width = (length // factor for length in grey.shape)
    # Crop to a multiple of the factor; cv2.resize would otherwise scale by a different factor.
    grey = np.ascontiguousarray(grey[: height * factor, : width * factor])
    if factor > 1:
        grey = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
    return Grey(np.asarray(grey, np.uint8), factor)


def sweep_image(
    views: Sequence[PosedCamera],
    key: int,
    greys: Mapping[int, Grey],
    xy: Floats,
    least_depth: float,
    *,
    threads: Executor,
) -> Swept:
    """Find the depths of an image's pixels for which other pictures agree on a unique depth.

    Args:
        views: the images.
        key: index of the image.
        greys: reduced pictures of this and the other images, by index.
        xy: float64 [n, 2] pixels of the image.
        least_depth: smallest depth to try; the largest is infinity.
        threads: executor for the comparisons.
    """
    view, grey = views[key], greys[key]
    others = [image for image in greys if image != key]
    # Skip patches that are flat or cross the image edge.
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


def _correlate(one: Grey, xy: Floats, two: Grey, at: Floats) -> NDArray[np.float32]:
    """Correlations [n, d] of patches at [n, 2] of one image and at [n, d, 2] of another."""
    return _core.correlate_patches(
        one.pixels, one.place(xy), two.pixels, two.place(at), min_deviation=_LEAST_DEVIATION
    )


def _seen_at(view: PosedCamera, other: PosedCamera, rays: Floats, inverse: Floats) -> Floats:
    """Project points on rays [n, 3] at inverse depths [n or 1, d] to pixels [n, d, 2].

    The pixels are in the image `other`, and NaN behind its camera or outside its field of view.
    """
    turn = other.cam_from_world[:, :3] @ view.cam_from_world[:, :3].T
    way = other.cam_from_world[:, 3] - turn @ view.cam_from_world[:, 3]
    # Coordinate by coordinate: NumPy is several times slower on rows of three elements.
    seen = (turn @ rays.T)[:, :, None] + way[:, None, None] * inverse
    seen[:, seen[2] <= 0] = np.nan
    points = seen.reshape(3, -1).T
    at = np.asarray(other.camera.img_from_cam(points)).reshape(-1, 2)
    at[~other.sees(points, at)] = np.nan
    return at.reshape(*seen.shape[1:], 2)


def _mean_of_best(found: NDArray[np.float32]) -> NDArray[np.float32]:
    """Mean of the largest two along the first axis, without sorting, which takes far longer."""
    best, second = np.maximum(*found[:2]), np.minimum(*found[:2])
    for other in found[2:]:
        np.maximum(second, np.minimum(best, other), out=second)
        np.maximum(best, other, out=best)
    return np.asarray((best + second) / 2)


def _is_clear(found: NDArray[np.float32], best: Ints) -> Bools:
    """Whether the best step of each row is good, and clearly better than all distant steps.

    The first step (infinity) and the last are rejected, because the true depth may lie beyond them.
    """
    score = np.take_along_axis(found, best[:, None], axis=1)
    beside = np.abs(np.arange(found.shape[1]) - best[:, None]) <= _BESIDE
    second = np.where(beside, -1.0, found).max(axis=1)
    inside = (best > 0) & (best < found.shape[1] - 1)
    is_clear = inside & (score[:, 0] >= _LEAST_CORRELATION) & (second < score[:, 0] - _MARGIN)
    return np.asarray(is_clear)


def _top(found: NDArray[np.float32], best: Ints) -> Floats:
    """Steps with subpixel refinement: maximum of a parabola through the best and adjacent steps."""
    beside = np.clip(best[:, None] + np.arange(-1, 2), 0, found.shape[1] - 1)
    left, middle, right = np.take_along_axis(found, beside, axis=1).astype(np.float64).T
    bend = left - 2 * middle + right
    is_top = (bend < 0) & (middle >= left) & (middle >= right)
    return np.asarray(
        best + np.where(is_top, 0.5 * (left - right) / np.where(is_top, bend, 1.0), 0.0)
    )


def _own_best(found: NDArray[np.float32], best: Ints) -> tuple[Floats, Bools]:
    """One picture's best step near the common best step, and whether it observes the point.

    Args:
        found: float32 [n, d] correlations of this picture.
        best: int64 [n] best steps of all pictures.
    """
    around = np.clip(best[:, None] + np.arange(-_BESIDE, _BESIDE + 1), 0, found.shape[1] - 1)
    own = np.take_along_axis(found, around, axis=1)
    rows = np.arange(len(best))
    where = own.argmax(axis=1)
    return _top(found, around[rows, where]), own[rows, where] >= _SEES
