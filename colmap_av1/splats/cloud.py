"""A point cloud for training Gaussian splats: evenly spread in the images, with holes filled."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from colmap_av1 import _core
from colmap_av1.geometry.coverage import (
    CELL,
    nearest_depth,
    squares_of_cells,
    valid_cells,
    without_gaps,
)
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.geometry.posed_camera import PosedCamera
from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.spread import evenly_spread

# Points are thinned in evenly spread images: at least 32, at most 128, in between every 6th image.
# Holes are filled in at most _FILLED_IMAGES images, which are evenly spread, too.
_EVEN_IMAGES = (32, 128, 6)
_FILLED_IMAGES = 128
# Widths in pixels of the image cells that should contain one point each, from coarse to fine.
# Closer points cost training time and prevent the trainer from placing its own.
_SPACINGS = (32, 16, 8)
# Points in the same cell whose depths differ by more than half an octave belong to different
# surfaces. Depths are quantized to at most _MOST_STEPS such steps.
_STEPS_PER_OCTAVE = 2.0
_MOST_STEPS = 64
# Share of `max_points` reserved for points of tracks; the rest may fill holes.
_FOR_SURFACES = 0.75
# Width in pixels of the squares that get one point each in an empty cell.
_FILLING = 8
# Added points may hide what another image shows through a gap. A second pass over all images finds
# such cells.
_ROUNDS = 2
# A hole shows the background. Depths at its edge that are nearer than this quantile by more than a
# factor are ignored, and each cell of the hole is interpolated from the nearest remaining ones.
_FARTHER = 0.75
_TOO_NEAR = 2.0
_NEAREST = 8
# An added point must not be nearer, by more than a factor, than the surfaces of neighbouring
# filled images. Multiples of the surrounding depth are tried in turn, then the largest depth.
_HIDES = 1.25
_PUSHED = (1.0, 1.5, 3.0)
_BESIDE = 2
# COLMAP's value for an unknown error.
_UNKNOWN_ERROR = -1.0


def splat_cloud(
    points: ModelPoints, images: Sequence[PosedCamera], max_points: int | None
) -> ModelPoints:
    """Thin points of tracks evenly in the images, and fill holes.

    Among nearby points on the same surface, the one with the most observations is kept. Empty cells
    of an image get points at the depth of their surroundings, observed by that image and its
    neighbours. Masked pixels are not holes.

    Args:
        points: points of tracks.
        images: the images.
        max_points: largest number of points; the finest spacing is dropped first. None: no limit.

    Returns:
        The kept points in their order, then the added points in black.
    """
    fewest, most, step = _EVEN_IMAGES
    even = evenly_spread(len(images), min(max(len(images) // step, fewest), most))
    stage = _stages(points, [images[i] for i in even])
    chosen = evenly_spread(len(images), _FILLED_IMAGES)
    # Shuffle within a stage: a limit would otherwise drop points at the end of the video.
    shuffled = np.random.default_rng(0).permutation(len(stage))
    order = np.lexsort((shuffled, stage))[: int((stage < len(_SPACINGS)).sum())]
    if max_points is None:
        kept = points.take(np.sort(order))
        return ModelPoints.concatenate([kept, _filling(kept, images, chosen)])
    # Filling holes has priority over detail, but needs surfaces that determine their depth.
    kept = points.take(order[: round(_FOR_SURFACES * max_points)])
    filled = _filling(kept, images, chosen)
    filled = filled.take(np.arange(min(len(filled.xyz), max_points - len(kept.xyz))))
    kept = points.take(np.sort(order[: max_points - len(filled.xyz)]))
    return ModelPoints.concatenate([kept, filled])


def _stages(points: ModelPoints, images: Sequence[PosedCamera]) -> Ints:
    """Index of the widest spacing at which each point is kept in one of the images, int64 [n].

    Points that are not kept at any spacing get the number of spacings.
    """
    # Prefer points with many observations, in the same order in all images.
    first = np.lexsort((points.error, -np.diff(points.offsets)))
    rank = np.empty(len(first), np.int64)
    rank[first] = np.arange(len(first))
    stage = np.full(len(rank), len(_SPACINGS))
    for image in images:
        index, xy, depth = image.project(points.xyz)
        best = _core.best_at_spacings(
            xy,
            depth,
            rank[index],
            width=image.size[0],
            height=image.size[1],
            spacings=np.array(_SPACINGS),
            steps_per_octave=_STEPS_PER_OCTAVE,
            most_steps=_MOST_STEPS,
        )
        stage[index] = np.minimum(stage[index], best)
    return stage


def _filling(kept: ModelPoints, images: Sequence[PosedCamera], chosen: list[int]) -> ModelPoints:
    """Points that fill the holes of the chosen images, one point of each cell first."""
    nearest = [nearest_depth(images[index], kept.xyz) for index in chosen]
    surfaces = [without_gaps(grid) for grid in nearest]
    usual = _usual_depth(surfaces)
    filled: list[ModelPoints] = [kept.take(np.empty(0, np.int64))]
    is_first = [np.empty(0, np.bool_)]
    added = np.empty((0, 3))
    for number in _spread_order(len(chosen)) * _ROUNDS:
        own = images[chosen[number]]
        grid = without_gaps(np.minimum(nearest[number], nearest_depth(own, added)))
        rows, columns = np.nonzero(np.isinf(grid) & valid_cells(own))
        if len(rows) == 0:
            continue
        depth = _depth_of_holes(grid, usual)
        xy, cell, first = _squares(own, rows, columns)
        is_first.append(first)
        beside = range(max(number - _BESIDE, 0), min(number + _BESIDE + 1, len(chosen)))
        xyz = _behind(
            own,
            xy,
            depth[rows, columns][cell],
            float(depth.max()),
            [(images[chosen[i]], surfaces[i]) for i in beside if i != number],
        )
        added = np.concatenate([added, xyz])
        around = (chosen[number] - 1, chosen[number], chosen[number] + 1)
        there = [i for i in around if 0 <= i < len(images)]
        filled.append(_with_observations(xyz, images, there, chosen[number]))
    order = np.argsort(~np.concatenate(is_first), kind="stable")
    return ModelPoints.concatenate(filled).take(order)


def _spread_order(count: int) -> list[int]:
    """0 to before `count` in bit-reversed order, which spreads the first ones evenly."""
    size = max(count - 1, 1).bit_length()
    order = (int(format(i, f"0{size}b")[::-1], 2) for i in range(1 << size))
    return [i for i in order if i < count]


def _usual_depth(surfaces: list[Floats]) -> float:
    """Depth assumed in an image without points."""
    known = np.concatenate([grid[np.isfinite(grid)] for grid in surfaces])
    return float(np.quantile(known, _FARTHER)) if len(known) else 1.0


def _depth_of_holes(grid: Floats, usual: float) -> Floats:
    """Fill the grid's holes with depths interpolated from the cells at their edges.

    If one side of a hole is near and another far, the hole is assumed to show the background, for
    example sky between roofs. A point that is too far away hides nothing.
    """
    from scipy.ndimage import binary_dilation, find_objects, label  # noqa: PLC0415 - slow to import
    from scipy.spatial import KDTree  # noqa: PLC0415

    depth = grid.copy()
    holes, count = label(np.isinf(grid), structure=np.ones((3, 3)))
    for number, found in enumerate(find_objects(holes, count), start=1):
        # The bounding box of the hole and its neighbouring cells.
        box = tuple(slice(max(s.start - 1, 0), s.stop + 1) for s in found)
        hole = holes[box] == number
        edge = np.argwhere(binary_dilation(hole, np.ones((3, 3))) & np.isfinite(grid[box]))
        if len(edge) == 0:
            depth[box][hole] = usual
            continue
        there = grid[box][edge[:, 0], edge[:, 1]]
        far = there > np.quantile(there, _FARTHER) / _TOO_NEAR
        tree = KDTree(edge[far])
        away, nearest = tree.query(np.argwhere(hole), k=np.arange(min(_NEAREST, far.sum())) + 1)
        weight = 1.0 / away**2
        inverse = (weight / there[far][nearest]).sum(axis=1) / weight.sum(axis=1)
        depth[box][hole] = 1.0 / inverse
    return np.asarray(depth)


def _squares(view: PosedCamera, rows: Ints, columns: Ints) -> tuple[Floats, Ints, Bools]:
    """Squares in cells: centres in pixels, cells, and whether each is the first of its cell."""
    per_cell = CELL // _FILLING
    xy = squares_of_cells(rows, columns, per_cell)
    cell = np.repeat(np.arange(len(rows)), per_cell**2)
    # Cells at the image edge may extend beyond it: move their first square inside.
    first = np.arange(len(xy)) % per_cell**2 == 0
    xy[first] = np.minimum(xy[first], np.array(view.size) - 0.5)
    # The centre of a square is a corner of four pixels, which must all be valid.
    around = [xy + np.array([dx, dy]) for dx in (-0.5, 0.5) for dy in (-0.5, 0.5)]
    inside = (xy < view.size).all(axis=1) & np.all([view.keeps(at) for at in around], axis=0)
    return xy[inside], cell[inside], first[inside]


def _behind(
    view: PosedCamera,
    xy: Floats,
    depth: Floats,
    farthest: float,
    others: Sequence[tuple[PosedCamera, Floats]],
) -> Floats:
    """Points at pixels and depths of an image, moved back if they would hide others' surfaces."""
    rays = view.rays(xy) @ view.cam_from_world[:, :3]
    xyz = view.centre + rays * np.maximum(depth, farthest)[:, None]
    left = np.arange(len(xy))
    for factor in _PUSHED:
        tried = view.centre + rays[left] * (depth[left] * factor)[:, None]
        hides = np.zeros(len(left), np.bool_)
        for other, surface in others:
            index, seen_at, own_depth = other.project(tried)
            column, row = (seen_at // CELL).astype(np.int64).T
            there = surface[row, column]
            hides[index] |= np.isfinite(there) & (own_depth * _HIDES < there)
        xyz[left[~hides]] = tried[~hides]
        left = left[hides]
        if len(left) == 0:
            break
    return np.asarray(xyz)


def _with_observations(
    xyz: Floats, images: Sequence[PosedCamera], seen_by: Sequence[int], own: int
) -> ModelPoints:
    """Points with observations in the images that they project into.

    The image `own`, which they were created for, observes all of them, even on masked pixels.
    """
    seen = []
    for i in seen_by:
        index, at, _ = images[i].project(xyz)
        kept = images[i].keeps(at) | (i == own)
        seen.append((i, index[kept], at[kept]))
    point = np.concatenate([index for _, index, _ in seen])
    image = np.concatenate([np.full(len(index), i) for i, index, _ in seen])
    xy = np.concatenate([at for *_, at in seen])
    order = np.lexsort((image, point))
    offsets = np.concatenate([[0], np.cumsum(np.bincount(point, minlength=len(xyz)))])
    black = np.zeros((len(xyz), 3), np.uint8)
    error = np.full(len(xyz), _UNKNOWN_ERROR)
    return ModelPoints(xyz, black, error, offsets.astype(np.int64), image[order], xy[order])
