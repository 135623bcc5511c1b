"""Find the points of a model that have observable depth, and the box to frame in pictures."""

from __future__ import annotations

import numpy as np
import pycolmap

from colmap_av1.geometry.colmap_model import camera_centres, posed_images
from colmap_av1.geometry.distant_points import distance_uncertainty
from colmap_av1.util.arrays import Bools, Floats

# A point's depth is observable below this relative uncertainty of its distance. Above it, points of
# a surface spread visibly along their rays.
_OBSERVABLE = 0.1
# Quantiles of the points that bound the framed box.
_FRAMED = (0.02, 0.98)


def has_observable_depth(model: pycolmap.Reconstruction) -> Bools:
    """Whether the images of a pycolmap.Reconstruction determine the distance of each point.

    The test uses the angles between the rays of a point's first, middle and last observation.
    Points without observations or without a reprojection error count as not observable. If no point
    has a reprojection error, that criterion is ignored; without any observations, all points count
    as observable.

    Returns:
        bool [num_points], in the order of the points' ids.
    """
    images = list(posed_images(model).values())
    index = {image.image_id: i for i, image in enumerate(images)}
    points = [model.points3D[i] for i in sorted(model.points3D)]
    views = [[index[i] for i in _three_images(p.track) if i in index] for p in points]
    lengths = np.array([len(own) for own in views], np.int64)
    rows = np.flatnonzero(lengths)
    if len(rows) == 0:
        return np.ones(len(points), np.bool_)
    error = np.array([points[i].error for i in rows], np.float64)
    is_known = error >= 0
    unsure = distance_uncertainty(
        np.array([points[i].xyz for i in rows], np.float64),
        np.maximum(error, 0.0),
        np.concatenate([[0], np.cumsum(lengths[rows])]).astype(np.int64),
        centres=camera_centres(np.array([image.cam_from_world for image in images])),
        view=np.array([view for own in views for view in own], np.int64),
        focal=np.array([model.cameras[i.camera_id].mean_focal_length() for i in images]),
    )
    observable = np.zeros(len(points), np.bool_)
    observable[rows] = (unsure < _OBSERVABLE) & (is_known | ~is_known.any())
    return observable


def _three_images(track: pycolmap.Track) -> list[int]:
    """The images of the first, middle and last observation; empty for an empty track."""
    length = track.length()
    return [int(track.element(k).image_id) for k in (0, length // 2, length - 1) if 0 <= k < length]


def framed_box(points: Floats, observable: Bools, centres: Floats) -> tuple[Floats, Floats]:
    """The box that contains all cameras and nearly all points with observable depth.

    Args:
        points: float64 [n, d] points, in coordinates along the axes of the box.
        observable: bool [n], see `has_observable_depth`; if none is, all points count.
        centres: float64 [m, d] camera centres, m > 0, in the same coordinates.

    Returns:
        float64 [d] the lowest and the highest corner.
    """
    low, high = centres.min(axis=0), centres.max(axis=0)
    framed = points[observable] if observable.any() else points
    if len(framed) == 0:
        return low, high
    least, most = np.quantile(framed, _FRAMED, axis=0)
    return np.minimum(low, least), np.maximum(high, most)
