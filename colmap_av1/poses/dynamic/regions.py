"""Dynamic regions of images, from the tracks in them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_av1.geometry.masks import Mask, make_mask
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.poses.dynamic.contradictions import Contradictions, TracksInCells
from colmap_av1.util.arrays import Bools, Floats

# Vote of a track that contradicts the poses by its motion alone, and not certainly. It is low
# because many such tracks arise where nothing guides the encoder, as in the sky.
_MOTION_VOTE = 0.3
# Width in cells of the neighbourhood whose votes are averaged, and fewest tracks there.
_AROUND = 5
_MIN_TRACKS = 4
# A cell may be dynamic if its mean vote exceeds that of static cells by the first value. It
# certainly is above the second, if as many points lie behind it as there are tracks: this excludes
# the sky, behind which nothing is seen. A dynamic region has at least this many certain cells in
# all images, and this share of them: people have two fifths or more, areas where the encoder finds
# no motion at most a fifth.
_MAY, _SURELY = 0.27, 0.6
_MIN_SURE = 400
_SURE_SHARE = 0.3
# A patch of a region in one image is kept if the mean votes of more than the second share of its
# cells exceed that of static cells by more than the first value. This drops patches that belong to
# a region only through other images, at the edges of where people have passed.
_STRONG, _STRONG_SHARE = 0.35, 0.3
# A track is dynamic if this share of its observations lies in dynamic cells, or the second share
# and it contradicts the poses.
_MOSTLY, _PARTLY = 0.55, 0.2
# A cell is dynamic if most tracks in a neighbourhood of this width in cells are, and at least this
# many.
_NEAR = 3
_MIN_DYNAMIC = 2
# The second pass no longer takes tracks known to be dynamic for evidence, and so finds more.
_PASSES = 2
# Width in cells of the holes that are closed.
_CLOSED = 3


def dynamic_cells(
    tracks: TracksInCells, views: Sequence[PosedCamera], *, num_threads: int | None = None
) -> Bools:
    """Find the dynamic cells of images.

    Args:
        tracks: tracks of a video in its images, about one per cell.
        views: the images, in temporal order.
        num_threads: number of threads; None: one per CPU. The result does not depend on it.

    Returns:
        Bool [images, rows, columns] the dynamic cells, dilated by one.
    """
    found = Contradictions(tracks, views, num_threads=num_threads)
    by_motion, surely = found.by_motion, found.surely_by_motion
    dynamic = np.zeros(len(by_motion), np.bool_)
    cells = np.zeros(tracks.shape, np.bool_)
    for _ in range(_PASSES):
        by_depth = found.by_depth(dynamic)
        behind = found.unseen(by_depth | dynamic)
        votes = np.where(by_depth | surely, 1.0, np.where(by_motion, _MOTION_VOTE, 0.0))
        share = shares_above_usual(tracks, votes, ~cells)
        cells = _sure_regions(tracks, share, behind)
        if not cells.any():
            return cells
        cells, dynamic = _cells_of_tracks(tracks, cells, by_motion | by_depth)
    return _closed(strong_patches(cells, share))


def _sum_around(cells: Floats, width: int) -> Floats:
    """Sums over squares of cells in each image."""
    from scipy.ndimage import uniform_filter  # noqa: PLC0415 - slow to import

    return np.asarray(uniform_filter(cells, (1, width, width), mode="constant") * width**2)


def shares_above_usual(tracks: TracksInCells, votes: Floats, still: Bools) -> Floats:
    """Mean vote of the tracks around each cell, less the median over static cells.

    Args:
        tracks: the tracks.
        votes: float64 [num_tracks] vote of each track for being dynamic, from 0 to 1.
        still: bool [images, rows, columns] cells not known to be dynamic. Where people cover a
            third of the pictures, the median of all cells would be too high and hide their edges.

    Returns:
        float64 [images, rows, columns]; -1 where there are too few tracks.
    """
    num_tracks = _sum_around(tracks.counts(np.ones(len(votes))), _AROUND)
    enough = num_tracks > _MIN_TRACKS - 0.5
    if not enough.any():
        return np.full(tracks.shape, -1.0)
    share = _sum_around(tracks.counts(votes), _AROUND) / np.maximum(num_tracks, 1.0)
    usual = share[enough & still] if (enough & still).any() else share[enough]
    return np.where(enough, share - float(np.median(usual)), -1.0)


def _sure_regions(tracks: TracksInCells, share: Floats, behind: Floats) -> Bools:
    """Regions connected in space and time with enough cells that are certainly dynamic.

    Args:
        tracks: the tracks.
        share: float64 [images, rows, columns] see `shares_above_usual`.
        behind: float64 [images, rows, columns] number of points there that only other images see.
    """
    from scipy.ndimage import label  # noqa: PLC0415 - slow to import

    num_tracks = _sum_around(tracks.counts(np.ones(len(tracks.residual))), _AROUND)
    region, count = label(share > _MAY, structure=np.ones((3, 3, 3)))
    sure = (share > _SURELY) & (_sum_around(behind, _AROUND) >= num_tracks)
    num_sure = np.bincount(region[sure], minlength=count + 1)
    num_cells = np.bincount(region.ravel(), minlength=count + 1)
    kept = (num_sure >= _MIN_SURE) & (num_sure >= _SURE_SHARE * num_cells)
    kept[0] = False
    return np.asarray(kept[region])


def strong_patches(cells: Bools, share: Floats) -> Bools:
    """The cells of the patches in which enough cells have high votes."""
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
    tracks: TracksInCells, cells: Bools, contradicts: Bools
) -> tuple[Bools, Bools]:
    """The cells in which most tracks are dynamic, and the dynamic tracks."""
    every = _sum_around(tracks.counts(np.ones(len(contradicts))), _NEAR)
    dynamic = np.zeros(len(contradicts), np.bool_)
    for _ in range(2):
        within = tracks.mean(cells[tracks.image, tracks.row, tracks.column])
        dynamic = (within > _MOSTLY) | ((within > _PARTLY) & contradicts)
        around = _sum_around(tracks.counts(dynamic), _NEAR)
        cells = (around > _MOSTLY * every) & (around > _MIN_DYNAMIC - 0.5)
    return cells, dynamic


def _closed(cells: Bools) -> Bools:
    """The cells with holes in space and time filled, dilated by one."""
    from scipy.ndimage import (  # noqa: PLC0415 - slow to import
        binary_closing,
        binary_dilation,
        binary_fill_holes,
    )

    square = np.ones((_CLOSED, _CLOSED), np.bool_)
    grown = np.empty_like(cells)
    lasting = cells.copy()
    # An image may lack tracks that its neighbours have.
    lasting[1:-1] |= cells[:-2] & cells[2:]
    for image, own in enumerate(lasting):
        padded = np.pad(own, _CLOSED)
        closed = binary_closing(padded, square)[_CLOSED:-_CLOSED, _CLOSED:-_CLOSED] | own
        grown[image] = binary_dilation(binary_fill_holes(closed), np.ones((3, 3)))
    return grown


def mask_of_cells(cells: Bools, cell: int, size: tuple[int, int]) -> Mask:
    """A mask of (width, height) that excludes cells [rows, columns]."""
    width, height = size
    dynamic = np.repeat(np.repeat(cells, cell, axis=0), cell, axis=1)[:height, :width]
    return make_mask(~dynamic)
