"""Check that files that are read several times do not change in between."""

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
    """The state of a file; it changes if the file is replaced or written to.

    Attributes:
        path: the file as given.
        found: path without symbolic links, size in bytes, and modification time in nanoseconds;
            None if there was no file.
    """

    path: Path
    found: tuple[str, int, int] | None


def file_state(file: str | os.PathLike[str]) -> FileState:
    """The current state of a file."""
    path = Path(file)
    try:
        status = path.stat()
    except OSError:
        return FileState(path, None)
    return FileState(path, (str(path.resolve()), status.st_size, status.st_mtime_ns))


def check_unchanged(*before: FileState) -> None:
    """Check that videos have not changed.

    Raises:
        VideoError: a video was changed, replaced or removed.
    """
    changed = next((state for state in before if file_state(state.path) != state), None)
    if changed is not None:
        raise VideoError(
            f"{changed.path}: changed or disappeared while it was read: leave it "
            "unchanged and run the same command again"
        )


@contextmanager
def unchanged(*before: FileState) -> Iterator[Callable[[], None]]:
    """Raise an error if videos change while the body reads them.

    Yields:
        A function that raises the error at once. Call it before keeping a result.

    Raises:
        VideoError: a video was changed, replaced or removed. It replaces an error of the body,
            which the change may have caused.
    """
    try:
        yield partial(check_unchanged, *before)
    except ColmapAv1Error:
        check_unchanged(*before)
        raise
    check_unchanged(*before)
