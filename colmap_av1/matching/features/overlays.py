"""Remove features of overlays: logos and displays that are fixed in the picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.features.sift import Features, are_similar
from colmap_av1.util.arrays import Floats, Ints
from colmap_av1.util.spread import evenly_spread

# Number of images, evenly spread, that each image is compared with.
_NUM_COMPARED = 8
# A feature is fixed if it stays in a cell of this width in pixels or moves to the next one.
_STILL = 1.0
# A feature belongs to an overlay if it is fixed in at least this share of the other images.
_LEAST_SHARE = 0.3
# If the median share of all features is above this, the camera stands still and none is removed.
_USUAL_SHARE = 0.25
# The camera stands still between two images if more than this share of the features of one is fixed
# in the other. These images are not compared. If it stands still, half of the features or more are
# fixed even with noise; an overlay has fewer.
_SCENE_SHARE = 0.4
# Side in pixels of the cells that overlays cover. Features at the edges of an overlay change with
# the scene behind it, so whole cells are removed.
_CELL = 16


def without_overlays(
    features: Mapping[int, Features], cameras: Sequence[pycolmap.Camera]
) -> dict[int, Features]:
    """Remove the features that stay at the same position while the rest of the picture changes.

    Such features match perfectly in all images, whatever the camera does.

    Args:
        features: the features of some images, by the index of the image.
        cameras: the camera of each image; only images of the same size are compared.

    Returns:
        The features of the same images; the same objects if nothing is removed.
    """
    groups: dict[tuple[int, int], list[int]] = {}
    for image in sorted(features):
        camera = cameras[image]
        groups.setdefault((int(camera.width), int(camera.height)), []).append(image)
    found = dict(features)
    for size, images in groups.items():
        shares = _shares_in_place([features[image] for image in images], size[0])
        if sum(map(len, shares)) == 0 or np.median(np.concatenate(shares)) > _USUAL_SHARE:
            continue
        columns = size[0] // _CELL + 1
        cells = [_cells(features[image].xy, _CELL, columns) for image in images]
        still = [np.unique(own[s >= _LEAST_SHARE]) for own, s in zip(cells, shares, strict=True)]
        cell, count = np.unique(np.concatenate(still), return_counts=True)
        over = cell[count >= _LEAST_SHARE * len(images)]
        for image, own, share in zip(images, cells, shares, strict=True):
            kept = ~np.isin(own, over) & (share < _LEAST_SHARE)
            if not kept.all():
                found[image] = features[image].only(kept)
    return found


def _cells(xy: NDArray[np.float32], side: float, columns: int) -> Ints:
    """Number of the square cell of each position, int64 [n]."""
    column, row = np.floor(xy / side).astype(np.int64).T
    return np.asarray(row * columns + column)


def _shares_in_place(features: Sequence[Features], width: int) -> list[Floats]:
    """The share of the other images in which each feature is fixed, float64 [n] of each image."""
    num_images = len(features)
    compared = evenly_spread(num_images, _NUM_COMPARED)
    image = np.repeat(compared, [len(features[k].xy) for k in compared])
    descriptors = np.concatenate([features[k].descriptors for k in compared])
    columns = int(width / _STILL) + 3  # keeps the last cell of a row apart from the next row
    cell = np.concatenate([_cells(features[k].xy, _STILL, columns) for k in compared])
    order = np.argsort(cell, kind="stable")
    cell, image, descriptors = cell[order], image[order], descriptors[order]
    around = np.array([row * columns + column for row in (-1, 0, 1) for column in (-1, 0, 1)])
    shares = []
    for k, own in enumerate(features):
        wanted = (_cells(own.xy, _STILL, columns)[:, None] + around).ravel()
        first, last = (np.searchsorted(cell, wanted, side) for side in ("left", "right"))
        count = last - first
        a = np.repeat(np.arange(len(wanted)) // len(around), count)
        b = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
        same = are_similar(own.descriptors[a], descriptors[b]) & (image[b] != k)
        seen, other = np.divmod(np.unique(a[same] * num_images + image[b[same]]), num_images)
        still = np.bincount(other, minlength=num_images) > _SCENE_SHARE * len(own.xy)
        others = max(1, sum(c != k and not still[c] for c in compared))
        shares.append(np.bincount(seen[~still[other]], minlength=len(own.xy)) / others)
    return shares
