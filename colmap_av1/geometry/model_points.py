"""The points of a model as arrays."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.arrays import Bools, Floats, Ints
from colmap_av1.util.grouping import take_rows

# Smallest number of observations of a point.
_FEWEST_OBSERVATIONS = 2


@dataclass(frozen=True)
class ModelPoints:
    """Points of a model and their observations, in compressed sparse row form.

    Point p has the observations offsets[p] : offsets[p + 1].

    Attributes:
        xyz: float64 [num_points, 3].
        rgb: uint8 [num_points, 3].
        error: float64 [num_points] mean reprojection error in pixels; -1 if unknown.
        offsets: int64 [num_points + 1].
        image: int64 [num_observations] index of the image.
        xy: float64 [num_observations, 2] position in pixels, the first pixel's centre at
            (0.5, 0.5).
    """

    xyz: Floats
    rgb: NDArray[np.uint8]
    error: Floats
    offsets: Ints
    image: Ints
    xy: Floats

    @property
    def point(self) -> Ints:
        """Index of the point of each observation: int64 [num_observations]."""
        return np.repeat(np.arange(len(self.xyz)), np.diff(self.offsets))

    @staticmethod
    def empty() -> ModelPoints:
        """No points."""
        return ModelPoints(
            np.empty((0, 3)),
            np.empty((0, 3), np.uint8),
            np.empty(0),
            np.zeros(1, np.int64),
            np.empty(0, np.int64),
            np.empty((0, 2)),
        )

    @staticmethod
    def concatenate(parts: Sequence[ModelPoints]) -> ModelPoints:
        """The points of several sets that refer to the same images, one set after the other."""
        counts = np.concatenate([np.diff(part.offsets) for part in parts])
        return ModelPoints(
            xyz=np.concatenate([part.xyz for part in parts]),
            rgb=np.concatenate([part.rgb for part in parts]),
            error=np.concatenate([part.error for part in parts]),
            offsets=np.concatenate([[0], np.cumsum(counts)]),
            image=np.concatenate([part.image for part in parts]),
            xy=np.concatenate([part.xy for part in parts]),
        )

    def take(self, rows: Ints) -> ModelPoints:
        """Select points, in the order of `rows`."""
        offsets, seen = take_rows(self.offsets, rows)
        return ModelPoints(
            self.xyz[rows],
            self.rgb[rows],
            self.error[rows],
            offsets,
            self.image[seen],
            self.xy[seen],
        )

    def keep_observations(self, kept: Bools) -> tuple[ModelPoints, Ints]:
        """Keep some of the observations, and the points with two or more of them.

        Args:
            kept: bool [num_observations].

        Returns:
            The points that are left, and int64 [n] their indices in these points.
        """
        so_far = np.concatenate([[0], np.cumsum(kept)])
        lengths = np.diff(so_far[self.offsets])
        enough = lengths >= _FEWEST_OBSERVATIONS
        seen = kept & np.repeat(enough, np.diff(self.offsets))
        left = ModelPoints(
            self.xyz[enough],
            self.rgb[enough],
            self.error[enough],
            np.concatenate([[0], np.cumsum(lengths[enough])]),
            self.image[seen],
            self.xy[seen],
        )
        return left, np.flatnonzero(enough)
