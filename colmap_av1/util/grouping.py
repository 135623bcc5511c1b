"""Elements grouped by an integer, such as observations by their image."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.util.arrays import Ints


def grouped(key: NDArray[np.integer[Any]], num_groups: int) -> tuple[Ints, Ints]:
    """Group elements by an integer. Within a group they keep their order.

    Args:
        key: integers [n], from 0 to below `num_groups`.
        num_groups: number of groups.

    Returns:
        int64 [n] order and int64 [num_groups + 1] bounds: the elements of group g are
        order[bounds[g] : bounds[g + 1]].
    """
    # NumPy sorts two-byte integers by radix sort, in a quarter of the time.
    order = np.argsort(key.astype(np.min_scalar_type(num_groups)), kind="stable")
    bounds = np.zeros(num_groups + 1, np.int64)
    np.cumsum(np.bincount(key, minlength=num_groups), out=bounds[1:])
    return order, bounds


def sums_beside_gaps(values: NDArray[Any], reach: int) -> NDArray[Any]:
    """For each gap between neighbours, the sum of up to `reach` values on either side.

    Args:
        values: [n] the values.
        reach: largest number of values on each side.

    Returns:
        [n - 1].
    """
    after = np.arange(1, len(values))
    total = np.append(0, np.cumsum(values))
    return np.asarray(
        total[np.minimum(after + reach, len(values))] - total[np.maximum(after - reach, 0)]
    )
