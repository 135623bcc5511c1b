"""Names of common array types."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]
# Pixels, uint8 [height, width] grey or [height, width, 3] BGR.
Picture = NDArray[np.uint8]
