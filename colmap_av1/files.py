"""Files that appear under their names only when whole."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden name in the file's folder to write it under; it gets its own name at the end.

    Whatever ends the body early, an interrupt too, leaves the file as it was, and nothing
    beside it.

    Raises:
        OSError: the file cannot be given its name.
    """
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
