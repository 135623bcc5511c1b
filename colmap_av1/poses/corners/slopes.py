"""How the surface around a point lies, by the points that are seen next to it.

What a picture shows of a slanted surface is sheared and squeezed in another view. Looked for as if
it faced the camera, it is found off its place, the more the farther apart the views are, and the
same way in all images on one side: poses bend by that, however many points there are.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_Floats = NDArray[np.float64]

# Neighbours that a plane goes through, the point itself among those that are asked for, and the
# pixels within which they lie.
_NEIGHBOURS = 17
_REACH = 40.0
# Pixels at which a neighbour counts half.
_NEAR = 15.0
# Difference of inverse depth from the plane, as a share of the point's, at which a neighbour counts
# half: those of another surface are left out by it.
_SCALE = 0.01
_STEPS = 5
# Neighbours on the plane at least, and the largest share by which inverse depth may change in a
# pixel: of a steeper surface next to nothing is seen.
_LEAST_NEIGHBOURS = 4.0
_STEEPEST = 0.01


def surface_slopes(xy: _Floats, depth: _Floats, around: _Floats, depth_around: _Floats) -> _Floats:
    """Planes through points of a picture and those next to them.

    The inverse depth of a plane is linear in the pixels of a pinhole camera. Each plane goes
    through its point; neighbours off it count less (Cauchy's weights).

    Args:
        xy: float64 [n, 2] places of points in pixels.
        depth: float64 [n] their distances along the axis of the camera.
        around: float64 [m, 2] places of all points.
        depth_around: float64 [m] their distances.

    Returns:
        float64 [n, 2] change of inverse depth by a pixel along x and along y, as a share of the
        point's; 0, as of a surface that faces the camera, where no plane has enough neighbours.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - slow to import

    if len(xy) == 0 or len(around) == 0:
        return np.zeros((len(xy), 2))
    distance, near = cKDTree(around).query(
        xy, k=range(1, _NEIGHBOURS + 1), distance_upper_bound=_REACH
    )
    # Where there are fewer, the index is one too large.
    there = np.isfinite(distance) & (distance > 0)
    near = np.where(there, near, 0)
    step = np.where(there[..., None], around[near] - xy[:, None], 0.0)
    change = np.where(there, depth[:, None] / depth_around[near] - 1, 0.0)
    nearness = np.where(there, 1 / (1 + (distance / _NEAR) ** 2), 0.0)
    slope, agreement = np.zeros((len(xy), 2)), np.ones_like(nearness)
    for _ in range(_STEPS):
        weight = nearness * agreement
        square = np.einsum("nk,nki,nkj->nij", weight, step, step) + 1e-9 * np.eye(2)
        right = np.einsum("nk,nki,nk->ni", weight, step, change)
        slope = np.linalg.solve(square, right[..., None])[..., 0]
        off = np.einsum("nki,ni->nk", step, slope) - change
        agreement = 1 / (1 + (off / _SCALE) ** 2)
    many = (agreement * there).sum(axis=1) >= _LEAST_NEIGHBOURS
    many &= np.linalg.norm(slope, axis=1) <= _STEEPEST
    return np.where(many[:, None], slope, 0.0)
