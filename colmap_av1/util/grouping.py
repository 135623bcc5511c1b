"""Elements grouped or selected by an integer, such as observations by their image."""

from __future__ import annotations

from itertools import pairwise
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


def groups(key: NDArray[np.integer[Any]], num_groups: int) -> list[Ints]:
    """The indices of the elements of each group, see `grouped`."""
    order, bounds = grouped(key, num_groups)
    return [order[first:last] for first, last in pairwise(bounds.tolist())]


def with_equal_keys(key: NDArray[np.integer[Any]], first: Ints, second: Ints) -> tuple[Ints, Ints]:
    """Pair the elements of two sets that have the same key, such as the track of an observation.

    Args:
        key: integers [n], the key of each element.
        first: indices of elements with distinct keys.
        second: indices of other elements with distinct keys.

    Returns:
        The elements of `first` and of `second` that have an equal in the other set, ordered by key.
    """
    _, of_first, of_second = np.intersect1d(
        key[first], key[second], assume_unique=True, return_indices=True
    )
    return first[of_first], second[of_second]


def indices_in(chosen: NDArray[np.integer[Any]], count: int) -> NDArray[np.int32]:
    """The index of each number in an array of distinct numbers.

    Args:
        chosen: integers [n], distinct, from 0 to below `count`.
        count: how many numbers there are.

    Returns:
        int32 [count]; -1 for the numbers that are not in `chosen`.
    """
    index = np.full(count, -1, np.int32)
    index[chosen] = np.arange(len(chosen), dtype=np.int32)
    return index


def take_rows(offsets: Ints, rows: Ints) -> tuple[Ints, Ints]:
    """Select rows of data in compressed sparse row form.

    Args:
        offsets: int64 [num_rows + 1] index of the first element of each row.
        rows: int64 [n] the rows to select, in this order.

    Returns:
        int64 [n + 1] offsets of the selected rows, and int64 [m] the indices of their elements.
    """
    lengths = offsets[rows + 1] - offsets[rows]
    taken = np.concatenate([[0], np.cumsum(lengths)]).astype(np.int64)
    return taken, np.arange(taken[-1]) + np.repeat(offsets[rows] - taken[:-1], lengths)


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
