"""Points of tracks that are too short to show whether they are dynamic."""

from __future__ import annotations

import numpy as np

from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.util.arrays import Bools, Ints

# Fewest observations of a point if all of its images have dynamic pixels.
_MIN_IMAGES = 5


def static_points(points: ModelPoints, shows_dynamic: Bools) -> Ints:
    """The points that are very likely static.

    In a few images, a point in uniform motion looks like a static point at another depth: only in
    a longer track do its rays fail to intersect. A short track is therefore accepted only if one of
    its images has no dynamic pixels.

    Args:
        points: points of tracks outside dynamic pixels.
        shows_dynamic: bool [num_images] which images have dynamic pixels.

    Returns:
        int64 [n] their indices, ascending.
    """
    if len(points.xyz) == 0:
        return np.empty(0, np.int64)
    count = np.diff(points.offsets)
    is_doubtful = np.logical_and.reduceat(shows_dynamic[points.image], points.offsets[:-1])
    return np.flatnonzero(~is_doubtful | (count >= _MIN_IMAGES))
