"""Distances between point clouds in the same coordinates."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from colmap_av1.util.arrays import Floats


@dataclass(frozen=True)
class CloudDistances:
    """Distances between two point clouds, in the reference's unit.

    Attributes:
        accuracy: mean distance from a point of the cloud to the nearest reference point.
        completeness: mean distance from a reference point to the nearest point of the cloud.
        hausdorff: the largest of all these distances, which a single outlier determines.
        mean_hausdorff: mean of the largest distances of both directions, as in arXiv 2605.14629.
        robust_hausdorff: the larger of the two 95th percentiles.
        extent: diagonal of the box that contains the middle 90 % of the reference on each axis.
    """

    accuracy: float
    completeness: float
    hausdorff: float
    mean_hausdorff: float
    robust_hausdorff: float
    extent: float

    @property
    def chamfer(self) -> float:
        """Chamfer distance: the mean of `accuracy` and `completeness`."""
        return (self.accuracy + self.completeness) / 2


def cloud_distances(points: Floats, reference: Floats) -> CloudDistances | None:
    """Compare two clouds in the same coordinates.

    Args:
        points: float64 [n, 3].
        reference: float64 [m, 3], for example the cloud of a trusted front-end.

    Returns:
        The distances; None if a cloud is empty, or the reference has no extent.
    """
    if len(points) == 0 or len(reference) == 0:
        return None
    middle = np.quantile(reference, [0.05, 0.95], axis=0)
    extent = float(np.linalg.norm(middle[1] - middle[0]))
    if extent == 0:
        return None
    to_reference, _ = KDTree(reference).query(points)
    to_points, _ = KDTree(points).query(reference)
    return CloudDistances(
        accuracy=float(to_reference.mean()),
        completeness=float(to_points.mean()),
        hausdorff=float(max(to_reference.max(), to_points.max())),
        mean_hausdorff=float((to_reference.max() + to_points.max()) / 2),
        robust_hausdorff=float(max(np.quantile(to_reference, 0.95), np.quantile(to_points, 0.95))),
        extent=extent,
    )
