"""The two-view geometry of an image pair and its configurations in COLMAP."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.arrays import Floats


class TwoViewConfig(IntEnum):
    """Configurations of two-view geometries, named and numbered as in COLMAP."""

    UNDEFINED = 0
    DEGENERATE = 1
    CALIBRATED = 2
    UNCALIBRATED = 3
    PLANAR = 4
    PANORAMIC = 5
    PLANAR_OR_PANORAMIC = 6
    WATERMARK = 7
    MULTIPLE = 8
    CALIBRATED_RIG = 9


# Configurations whose pairs the mappers of COLMAP 4.2 ignore, and those without depth.
UNUSED_CONFIGS = (TwoViewConfig.UNDEFINED, TwoViewConfig.DEGENERATE, TwoViewConfig.WATERMARK)
FLAT_CONFIGS = (
    TwoViewConfig.PLANAR,
    TwoViewConfig.PANORAMIC,
    TwoViewConfig.PLANAR_OR_PANORAMIC,
)


def config_name(config: int) -> str:
    """COLMAP's name of a configuration; the number if COLMAP has no name for it."""
    return TwoViewConfig(config).name if config in set(TwoViewConfig) else str(config)


@dataclass(frozen=True)
class TwoViewGeometry:
    """Geometry of one image pair, from the pair's first image to its second.

    Attributes:
        config: configuration.
        inlier_matches: uint32 [n, 2] the inliers, in the order of the matches.
        E: float64 [3, 3] essential matrix on normalised, undistorted coordinates, or None.
        F: float64 [3, 3] fundamental matrix on pixels; None if E explains enough matches
            without it, or if none was found.
        H: float64 [3, 3] homography on pixels, or None.
        qvec: float64 [4] (w, x, y, z) rotation from the first camera to the second, or None.
        tvec: float64 [3] translation likewise, of unit length, or None.
    """

    config: TwoViewConfig
    inlier_matches: NDArray[np.uint32]
    E: Floats | None = None
    F: Floats | None = None
    H: Floats | None = None
    qvec: Floats | None = None
    tvec: Floats | None = None
