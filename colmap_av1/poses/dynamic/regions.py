"""Regions of images that move by themselves, from the tracks in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.coverage import PosedCamera
from colmap_av1.geometry.masks import Mask, make_mask
from colmap_av1.poses.dynamic.contradictions import Contradictions, PlacedTracks

_Floats = NDArray[np.float64]
_Bools = NDArray[np.bool_]

# What a track says of the cells around it that contradicts by its motion alone, and not surely:
# much does where nothing guides an encoder, as in the sky.
_BY_MOTION = 0.3
# Width in cells of what is summed up, and tracks there at least.
_AROUND = 5
_FEWEST_TRACKS = 4
# Share of the tracks, above that of what stands still, from which on a cell may move, and from
# which on it surely does, if other images see as many points behind as there are tracks: nobody has
# seen what is behind the sky. A region has so many sure cells in all its images, and they are so
# large a share of it: two fifths and more of people, a fifth at most of what encoders find no
# motion for.
_MAY, _SURELY = 0.27, 0.6
_FEWEST_SURE = 400
_SURE_SHARE = 0.3
# Share, as above, of the cells in a patch of an image, and share of those in the patch: what joins
# a region in time only, at the edges of what people passed, has fewer.
_STRONG, _STRONG_SHARE = 0.35, 0.3
# A track moves that is in such cells in most of its images, or in some and contradicts.
_MOSTLY, _PARTLY = 0.55, 0.2
# Width in cells in which most tracks, and so many, move.
_NEAR = 3
_FEWEST_MOVING = 2
# What is found without those that are known to move shows more of them.
_PASSES = 2
# Holes of this many cells are closed.
_CLOSED = 3


def moving_cells(placed: PlacedTracks, views: Sequence[PosedCamera]) -> _Bools:
    """Find what moves by itself.

    Args:
        placed: tracks of a video in its images, about one a cell.
        views: the images, in the order of time.

    Returns:
        Bool [images, rows, columns] the cells that move, grown by one.
    """
    found = Contradictions(placed, views)
    by_motion, surely = found.by_motion, found.surely_by_motion
    moving = np.zeros(len(by_motion), np.bool_)
    cells = np.zeros(placed.shape, np.bool_)
    for _ in range(_PASSES):
        by_depth = found.by_depth(moving)
        behind = found.unseen(by_depth | moving)
        says = np.where(by_depth | surely, 1.0, np.where(by_motion, _BY_MOTION, 0.0))
        share = shares_above_usual(placed, says, ~cells)
        cells = _sure_regions(placed, share, behind)
        if not cells.any():
            return cells
        cells, moving = _cells_of_tracks(placed, cells, by_motion | by_depth)
    return _closed(strong_patches(cells, share))


def _sum_around(cells: _Floats, width: int) -> _Floats:
    """Sums over squares of cells in each image."""
    from scipy.ndimage import uniform_filter  # noqa: PLC0415 - slow to import

    return np.asarray(uniform_filter(cells, (1, width, width), mode="constant") * width**2)


def shares_above_usual(placed: PlacedTracks, says: _Floats, still: _Bools) -> _Floats:
    """How far the tracks around each cell say that it moves, above the median of what is still.

    Args:
        placed: the tracks.
        says: float64 [num_tracks] how far each of them says that something moves.
        still: bool [images, rows, columns] what is not known to move. Where people cover a third of
            the pictures, the median of all cells is theirs in part, and hides their edges.

    Returns:
        float64 [images, rows, columns]; below 0 where there are too few tracks.
    """
    tracks = _sum_around(placed.counts(np.ones(len(says))), _AROUND)
    enough = tracks > _FEWEST_TRACKS - 0.5
    if not enough.any():
        return np.full(placed.shape, -1.0)
    share = _sum_around(placed.counts(says), _AROUND) / np.maximum(tracks, 1.0)
    usual = share[enough & still] if (enough & still).any() else share[enough]
    return np.where(enough, share - float(np.median(usual)), -1.0)


def _sure_regions(placed: PlacedTracks, share: _Floats, behind: _Floats) -> _Bools:
    """Connected cells in space and time of which enough surely move.

    Args:
        placed: the tracks.
        share: float64 [images, rows, columns] how far tracks say that something moves.
        behind: float64 [images, rows, columns] points that only other images see there.
    """
    from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    tracks = _sum_around(placed.counts(np.ones(len(placed.off))), _AROUND)
    region, count = label(share > _MAY, structure=np.ones((3, 3, 3)))
    sure = (share > _SURELY) & (_sum_around(behind, _AROUND) >= tracks)
    num_sure = np.bincount(region[sure], minlength=count + 1)
    num_cells = np.bincount(region.ravel(), minlength=count + 1)
    kept = (num_sure >= _FEWEST_SURE) & (num_sure >= _SURE_SHARE * num_cells)
    kept[0] = False
    return np.asarray(kept[region])


def strong_patches(cells: _Bools, share: _Floats) -> _Bools:
    """The cells in those patches of images of which enough move strongly."""
    from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    found = np.zeros_like(cells)
    for image, own in enumerate(cells):
        patch, count = label(own, structure=np.ones((3, 3)))
        strong = np.bincount(patch[share[image] > _STRONG], minlength=count + 1)
        kept = strong > _STRONG_SHARE * np.bincount(patch.ravel(), minlength=count + 1)
        kept[0] = False
        found[image] = kept[patch]
    return found


def _cells_of_tracks(
    placed: PlacedTracks, cells: _Bools, contradicts: _Bools
) -> tuple[_Bools, _Bools]:
    """The cells in which most tracks move, and these: what a track is part of it stays part of."""
    every = _sum_around(placed.counts(np.ones(len(contradicts))), _NEAR)
    moving = np.zeros(len(contradicts), np.bool_)
    for _ in range(2):
        within = placed.mean(cells[placed.image, placed.row, placed.column])
        moving = (within > _MOSTLY) | ((within > _PARTLY) & contradicts)
        around = _sum_around(placed.counts(moving), _NEAR)
        cells = (around > _MOSTLY * every) & (around > _FEWEST_MOVING - 0.5)
    return cells, moving


def _closed(cells: _Bools) -> _Bools:
    """The cells without holes in images and between them, and grown by one."""
    from scipy.ndimage import (  # noqa: PLC0415 - slow to import
        binary_closing,
        binary_dilation,
        binary_fill_holes,
    )

    square = np.ones((_CLOSED, _CLOSED), np.bool_)
    grown = np.empty_like(cells)
    lasting = cells.copy()
    # An image may lack the tracks that those before and after have.
    lasting[1:-1] |= cells[:-2] & cells[2:]
    for image, own in enumerate(lasting):
        padded = np.pad(own, _CLOSED)
        closed = binary_closing(padded, square)[_CLOSED:-_CLOSED, _CLOSED:-_CLOSED] | own
        grown[image] = binary_dilation(binary_fill_holes(closed), np.ones((3, 3)))
    return grown


def mask_of_cells(cells: _Bools, cell: int, size: tuple[int, int]) -> Mask:
    """A mask of (width, height) that leaves out cells [rows, columns]."""
    width, height = size
    moving = np.repeat(np.repeat(cells, cell, axis=0), cell, axis=1)[:height, :width]
    return make_mask(~moving)
