"""Which positions are valid."""

from __future__ import annotations

import numpy as np

from colmap_av1.util.arrays import Bools, Floats


def are_places(places: Floats) -> Bools:
    """Which positions (latitude, longitude, altitude), float64 [n, 3], are valid for a camera.

    Latitude and longitude 0 are invalid, because receivers write them without a fix.
    """
    latitude, longitude, altitude = np.nan_to_num(places, nan=np.inf).T
    on_earth = (abs(latitude) <= 90) & (abs(longitude) <= 180) & (abs(altitude) < 1e5)
    return np.asarray(on_earth & ((latitude != 0) | (longitude != 0)))
