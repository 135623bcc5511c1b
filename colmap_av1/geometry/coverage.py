"""Coverage: the share of image cells that a point cloud projects into."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pycolmap

from colmap_av1 import _core
from colmap_av1.geometry.colmap_model import point_positions, posed_images
from colmap_av1.geometry.posed_camera import PosedCamera, views_of
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.spread import evenly_spread

# Width of a cell in pixels.
CELL = 16
# A point is hidden by a surface and only visible through its gaps if at least 7 of the 8
# neighbouring cells have points that are nearer by this factor.
_NEARER = 1.25
_AROUND = 8
# Largest number of images, evenly spread, in which coverage is measured, to limit the time.
_MOST_IMAGES = 64


def coverage(views: Sequence[PosedCamera], xyz: Floats) -> float:
    """Share of the images' cells of 16x16 pixels into which a visible point projects.

    A point that is visible only through a gap in a nearer surface does not count, and neither do
    masked cells. At most 64 images, evenly spread, are measured.

    Args:
        views: the images.
        xyz: float64 [n, 3] the points.

    Returns:
        The share from 0 to 1; 0 without images.
    """
    filled = total = 0
    for view in (views[i] for i in evenly_spread(len(views), _MOST_IMAGES)):
        depth = without_gaps(nearest_depth(view, xyz))
        cells = valid_cells(view)
        filled += int(np.isfinite(depth[cells]).sum())
        total += int(cells.sum())
    return filled / max(total, 1)


def coverage_of_model(reconstruction: pycolmap.Reconstruction) -> float:
    """`coverage` of a pycolmap.Reconstruction's points in its images."""
    images = sorted(posed_images(reconstruction).values(), key=lambda image: image.name)
    cameras = reconstruction.cameras
    views = views_of(images, dict(cameras))
    return coverage(views, point_positions(reconstruction))


def valid_cells(view: PosedCamera) -> Bools:
    """Cells of an image with valid pixels and a ray in the middle, bool [rows, columns]."""
    width, height = view.size
    rows, columns = -(-height // CELL), -(-width // CELL)
    y, x = np.mgrid[:rows, :columns].reshape(2, -1) * CELL + CELL / 2
    middle = np.minimum(np.column_stack([x, y]), view.size)
    seen = view.have_rays(middle).reshape(rows, columns)
    if view.mask is None:
        return seen
    own = [(np.arange(n) + 0.5) * m / n for n, m in zip(view.size, view.mask.size, strict=True)]
    kept = np.zeros((rows * CELL, columns * CELL), dtype=np.bool_)
    kept[:height, :width] = view.mask.kept[np.ix_(own[1].astype(int), own[0].astype(int))]
    return np.asarray(seen & kept.reshape(rows, CELL, columns, CELL).any(axis=(1, 3)))


def nearest_depth(view: PosedCamera, xyz: Floats) -> Floats:
    """Depth of the nearest point in each cell of an image, including points in gaps.

    Args:
        view: the image.
        xyz: float64 [n, 3] the points.

    Returns:
        float64 [rows, columns]; inf for cells without a point.
    """
    _, xy, depth = view.project(xyz)
    return nearest_in_cells(view.size, xy, depth)


def nearest_in_cells(size: tuple[int, int], xy: Floats, depth: Floats) -> Floats:
    """Smallest depth in each cell of an image of `size`, of depths [n] at pixels [n, 2]."""
    columns, rows = (-(-length // CELL) for length in size)
    # The core assigns pixels on the right and bottom edges to the last cell.
    return _core.nearest_in_cells(xy, depth, cell=CELL, columns=columns, rows=rows)


def squares_of_cells(rows: Ints, columns: Ints, per_side: int) -> Floats:
    """Centres in pixels [n, 2] of the squares in cells, `per_side` ** 2 for each cell in turn."""
    offsets = (np.arange(per_side) + 0.5) * (CELL / per_side)
    x = columns[:, None] * CELL + np.tile(offsets, per_side)
    y = rows[:, None] * CELL + np.repeat(offsets, per_side)
    return np.stack([x, y], axis=-1).reshape(-1, 2).astype(np.float64)


def without_gaps(grid: Floats) -> Floats:
    """Nearest depths, with inf for cells well behind at least 7 of their 8 neighbours."""
    rows, columns = grid.shape
    padded = np.pad(grid, 1, constant_values=np.inf)
    limit = grid / _NEARER
    nearer = np.zeros(grid.shape, np.int64)
    for row in range(3):
        for column in range(3):
            nearer += padded[row : row + rows, column : column + columns] < limit
    return np.where(nearer >= _AROUND - 1, np.inf, grid)
