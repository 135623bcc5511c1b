"""Indices that are evenly spaced over a sequence."""

from __future__ import annotations

import numpy as np


def evenly_spread(count: int, most: int, *, rounded: bool = False) -> list[int]:
    """At most `most` indices below `count`, evenly spaced from the first to the last.

    Args:
        count: length of the sequence.
        most: largest number of indices.
        rounded: round positions to the nearest index instead of down.
    """
    position = np.linspace(0, count - 1, max(min(most, count), 0))
    return sorted(set((position.round() if rounded else position).astype(int).tolist()))
