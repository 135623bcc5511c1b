"""Slant of the surface at each point, from the neighbouring points.

A patch of a slanted surface is sheared and foreshortened in another view. Searched as if it faced
the camera, it is found at a biased position. The bias grows with the distance between the views and
has the same sign in all images on one side, so that it bends the poses however many points there
are.
"""

from __future__ import annotations

import numpy as np

from colmap_av1.util.arrays import Floats

# Number of nearest neighbours that a plane is fitted to, including the point itself, and their
# largest distance in pixels.
_NEIGHBOURS = 17
_MAX_DISTANCE = 40.0
# Distance in pixels at which a neighbour has half the weight.
_DISTANCE_SCALE = 15.0
# Difference of inverse depth from the plane, relative to the point's inverse depth, at which a
# neighbour has half the weight. It excludes points of other surfaces.
_RESIDUAL_SCALE = 0.01
_STEPS = 5
# Smallest sum of the weights of neighbours, and largest relative change of inverse depth per pixel:
# hardly anything of a steeper surface is visible.
_MIN_NEIGHBOURS = 4.0
_MAX_SLOPE = 0.01


def surface_slopes(xy: Floats, depth: Floats, around: Floats, depth_around: Floats) -> Floats:
    """Fit a plane to the neighbours of each point in a picture.

    The inverse depth of a plane is linear in the pixels of a pinhole camera. Each plane passes
    through its point; its neighbours have Cauchy weights.

    Args:
        xy: float64 [n, 2] positions of points in pixels.
        depth: float64 [n] their depths.
        around: float64 [m, 2] positions of all points.
        depth_around: float64 [m] their depths.

    Returns:
        float64 [n, 2] change of inverse depth per pixel along x and along y, relative to the
        point's inverse depth; 0, as for a surface that faces the camera, where the plane has too
        few neighbours.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    if len(xy) == 0 or len(around) == 0:
        return np.zeros((len(xy), 2))
    distance, near = cKDTree(around).query(
        xy, k=range(1, _NEIGHBOURS + 1), distance_upper_bound=_MAX_DISTANCE
    )
    # The tree returns an index out of range for each missing neighbour.
    there = np.isfinite(distance) & (distance > 0)
    near = np.where(there, near, 0)
    step = np.where(there[..., None], around[near] - xy[:, None], 0.0)
    change = np.where(there, depth[:, None] / depth_around[near] - 1, 0.0)
    nearness = np.where(there, 1 / (1 + (distance / _DISTANCE_SCALE) ** 2), 0.0)
    slope, agreement = np.zeros((len(xy), 2)), np.ones_like(nearness)
    for _ in range(_STEPS):
        weight = nearness * agreement
        square = np.einsum("nk,nki,nkj->nij", weight, step, step) + 1e-9 * np.eye(2)
        right = np.einsum("nk,nki,nk->ni", weight, step, change)
        slope = np.linalg.solve(square, right[..., None])[..., 0]
        residual = np.einsum("nki,ni->nk", step, slope) - change
        agreement = 1 / (1 + (residual / _RESIDUAL_SCALE) ** 2)
    many = (agreement * there).sum(axis=1) >= _MIN_NEIGHBOURS
    many &= np.linalg.norm(slope, axis=1) <= _MAX_SLOPE
    return np.where(many[:, None], slope, 0.0)
