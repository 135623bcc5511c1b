"""Points of tracks that are too short to tell what moves from what stands still."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from colmap_av1.geometry.colmap_model import ModelPoints

# Images that see a point, at least, where all of them show something that moves.
_FEWEST_IMAGES = 5


def surely_still(points: ModelPoints, shows_moving: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The points that stand still for all that is known.

    For a few images whatever moves on evenly has the place of a point that stands still, nearer or
    farther than it is: only where it goes on long enough do its rays miss each other. A short track
    counts where one of its images shows nothing that moves.

    Args:
        points: points of tracks that masks of what moves have left.
        shows_moving: bool [num_images] which images show something that moves.

    Returns:
        int64 [n] their indices, ascending.
    """
    if len(points.xyz) == 0:
        return np.empty(0, np.int64)
    count = np.diff(points.offsets)
    beside = np.logical_and.reduceat(shows_moving[points.image], points.offsets[:-1])
    return np.flatnonzero(~beside | (count >= _FEWEST_IMAGES))
