"""Files that are read several times, and must not change meanwhile."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from colmap_av1.errors import ColmapAv1Error, VideoError


@dataclass(frozen=True)
class FileState:
    """The state of a file, which differs where it is replaced or written to.

    Attributes:
        path: the file, as it was given.
        found: path without links, bytes and time of the last change in nanoseconds; None: there
            was no file.
    """

    path: Path
    found: tuple[str, int, int] | None


def file_state(file: str | os.PathLike[str]) -> FileState:
    """The state of a file now."""
    path = Path(file)
    try:
        status = path.stat()
    except OSError:
        return FileState(path, None)
    return FileState(path, (str(path.resolve()), status.st_size, status.st_mtime_ns))


def check_unchanged(*before: FileState) -> None:
    """Check that videos are as they were.

    Raises:
        VideoError: one was changed, replaced or removed.
    """
    changed = next((state for state in before if file_state(state.path) != state), None)
    if changed is not None:
        raise VideoError(
            f"{changed.path}: changed or disappeared while it was read: leave it "
            "unchanged, and run the same command again"
        )


@contextmanager
def unchanged(*before: FileState) -> Iterator[Callable[[], None]]:
    """Refuse videos that change while the body reads them.

    Yields:
        Refuses them at once where they have changed already: for before something is kept.

    Raises:
        VideoError: one was changed, replaced or removed; in place of the body's error, too, which
            may come of that.
    """
    try:
        yield partial(check_unchanged, *before)
    except ColmapAv1Error:
        check_unchanged(*before)
        raise
    check_unchanged(*before)
