"""Features of what lies over the pictures, which is not part of the scene: logos, displays."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.matching.features.sift import Features, alike
from colmap_av1.util.spread import evenly_spread

# Images that each is held against, spread over all.
_NUM_COMPARED = 8
# Pixels that a feature may move by between pictures and still be in its place.
_STILL = 1.0
# Share of other images that show an overlay's feature in its place, at least, and that which usual
# features may have: where the camera rests all of them stay.
_LEAST_SHARE = 0.3
_USUAL_SHARE = 0.25
# Side in pixels of the cells that overlays fill: features at their edges change with what is below.
_CELL = 16


def without_overlays(
    features: Mapping[int, Features], cameras: Sequence[pycolmap.Camera]
) -> dict[int, Features]:
    """Leave out the features that stay in their place in pictures that else change.

    They would match whatever the pictures show, and as well as nothing else does.

    Args:
        features: those of images, by the numbers of these.
        cameras: of all images; only those of one size are held against each other.

    Returns:
        The features of the same images; the same objects where none is left out.
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


def _cells(xy: NDArray[np.float32], side: float, columns: int) -> NDArray[np.int64]:
    """Int64 [n] the squares that positions lie in, so many beside each other."""
    column, row = np.floor(xy / side).astype(np.int64).T
    return np.asarray(row * columns + column)


def _shares_in_place(features: Sequence[Features], width: int) -> list[NDArray[np.float64]]:
    """Of each feature of some images, the share of other images that show it in its place."""
    num_images = len(features)
    compared = evenly_spread(num_images, _NUM_COMPARED)
    image = np.repeat(compared, [len(features[k].xy) for k in compared])
    descriptors = np.concatenate([features[k].descriptors for k in compared])
    columns = int(width / _STILL) + 3  # none is beside the first of the next row
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
        same = alike(own.descriptors[a], descriptors[b]) & (image[b] != k)
        seen = np.unique(a[same] * num_images + image[b[same]]) // num_images
        others = max(1, len(compared) - (k in compared))
        shares.append(np.bincount(seen, minlength=len(own.xy)) / others)
    return shares
