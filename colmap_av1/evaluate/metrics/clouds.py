"""Distances between point clouds in the same coordinates, and depth differences in images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import KDTree

# Smallest track length of a reference point, and number of nearby reference points to consider.
_REFERENCE_LENGTH = 4
_NEAREST = 3


@dataclass(frozen=True)
class CloudDistances:
    """Distances between two point clouds, in the reference's unit.

    Attributes:
        accuracy: mean distance from a point of the cloud to the nearest reference point.
        completeness: mean distance from a reference point to the nearest point of the cloud.
        hausdorff: the largest of all these distances, which a single outlier determines.
        robust_hausdorff: the larger of the two 95th percentiles.
        extent: diagonal of the box that contains the middle 90 % of the reference on each axis.
    """

    accuracy: float
    completeness: float
    hausdorff: float
    robust_hausdorff: float
    extent: float

    @property
    def chamfer(self) -> float:
        """Chamfer distance: the mean of `accuracy` and `completeness`."""
        return (self.accuracy + self.completeness) / 2


def cloud_distances(
    points: NDArray[np.float64], reference: NDArray[np.float64]
) -> CloudDistances | None:
    """Compare two clouds in the same coordinates.

    Args:
        points: float64 [n, 3].
        reference: float64 [m, 3], for example the cloud of a trusted front-end.

    Returns:
        The distances; None if a cloud is empty.
    """
    if len(points) == 0 or len(reference) == 0:
        return None
    to_reference, _ = KDTree(reference).query(points)
    to_points, _ = KDTree(points).query(reference)
    middle = np.quantile(reference, [0.05, 0.95], axis=0)
    return CloudDistances(
        accuracy=float(to_reference.mean()),
        completeness=float(to_points.mean()),
        hausdorff=float(max(to_reference.max(), to_points.max())),
        robust_hausdorff=float(max(np.quantile(to_reference, 0.95), np.quantile(to_points, 0.95))),
        extent=float(np.linalg.norm(middle[1] - middle[0])),
    )


def depth_differences(
    model: pycolmap.Reconstruction, reference: pycolmap.Reconstruction, *, pixels: float = 5.0
) -> NDArray[np.float64]:
    """Relative differences between a model's depths and those of nearby reference points.

    Each point is projected into the middle image of its track. Of the three nearest reference
    points there with four or more observations, the one with the most similar depth counts, because
    at an occlusion boundary others lie on the background.

    Args:
        model: a pycolmap.Reconstruction.
        reference: another model with the same poses and image ids.
        pixels: largest distance in the image to a reference point, in pixels.

    Returns:
        float64 [num_points], in the order of the point ids: the difference divided by the
        reference's depth; NaN if no reference point is near.
    """
    ids = sorted(model.points3D)
    xyz = point_cloud(model)
    middle = np.array([_middle_image(model.points3D[i].track) for i in ids], np.int64)
    difference = np.full(len(ids), np.nan)
    for image_id in np.unique(middle):
        seen = [
            (p.xy, reference.points3D[p.point3D_id].xyz)
            for p in reference.images[image_id].points2D
            if p.has_point3D()
            and reference.points3D[p.point3D_id].track.length() >= _REFERENCE_LENGTH
        ]
        if not seen:
            continue
        image = model.images[image_id]
        pose = np.asarray(image.cam_from_world().matrix())
        own = np.flatnonzero(middle == image_id)
        in_camera = xyz[own] @ pose[:, :3].T + pose[:, 3]
        own, in_camera = own[in_camera[:, 2] > 0], in_camera[in_camera[:, 2] > 0]
        xy, there = (np.array(column) for column in zip(*seen, strict=True))
        depth = np.append(there @ pose[2, :3] + pose[2, 3], np.nan)
        projected = np.asarray(model.cameras[image.camera_id].img_from_cam(in_camera))
        # KDTree returns len(xy) for a missing neighbour, whose depth here is NaN.
        _, near = KDTree(xy).query(projected, k=_NEAREST, distance_upper_bound=pixels)
        off = np.abs(in_camera[:, 2:] / depth[near] - 1)
        difference[own] = np.fmin.reduce(off, axis=1)
    return difference


def _middle_image(track: pycolmap.Track) -> int:
    image_ids = sorted(int(element.image_id) for element in track.elements)
    return image_ids[len(image_ids) // 2]


def point_cloud(model: pycolmap.Reconstruction) -> NDArray[np.float64]:
    """The points of a pycolmap.Reconstruction: float64 [n, 3], in the order of their ids."""
    points = [model.points3D[i].xyz for i in sorted(model.points3D)]
    return np.array(points, dtype=np.float64).reshape(-1, 3)
