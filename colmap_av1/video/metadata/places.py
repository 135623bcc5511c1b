"""Which positions can be those of a camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def are_places(places: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Which latitudes, longitudes and altitudes [n, 3] can be those of a camera.

    Both angles 0 is what receivers write without a fix.
    """
    latitude, longitude, altitude = np.nan_to_num(places, nan=np.inf).T
    on_earth = (abs(latitude) <= 90) & (abs(longitude) <= 180) & (abs(altitude) < 1e5)
    return np.asarray(on_earth & ((latitude != 0) | (longitude != 0)))
