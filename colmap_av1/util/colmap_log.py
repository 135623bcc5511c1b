"""The log of COLMAP in this process."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import pycolmap


@contextmanager
def only_errors() -> Iterator[None]:
    """Within the context, COLMAP logs nothing but errors."""
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = max(level, int(pycolmap.logging.ERROR))
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = level
