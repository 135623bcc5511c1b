"""Files that are read several times, and must stay as they are meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path

from colmap_av1.errors import ColmapAv1Error, VideoError

# Path, bytes and time of the last change in nanoseconds; None: there is no file.
FileState = tuple[str, int, int] | None


def file_states(*paths: Path) -> dict[Path, FileState]:
    """What tells files from such as take their place, or the same ones written on."""
    return {path: _state(path) for path in paths}


def _state(path: Path) -> FileState:
    try:
        status = path.stat()
    except OSError:
        return None
    return str(path.resolve()), status.st_size, status.st_mtime_ns


def check_unchanged(before: Mapping[Path, FileState]) -> None:
    """Check that videos are as they were.

    Raises:
        VideoError: one was changed, replaced or removed.
    """
    changed = next((path for path, state in before.items() if _state(path) != state), None)
    if changed is not None:
        raise VideoError(
            f"{changed}: changed or went while it was read: let it be, and run the same command "
            "again"
        )


@contextmanager
def unchanged(*videos: Path) -> Iterator[Callable[[], None]]:
    """Refuse videos that do not stay as they are while the body reads them.

    Yields:
        Refuses them at once where they have changed already: for before something is kept.

    Raises:
        VideoError: one was changed, replaced or removed; in place of the body's error, too, which
            may come of that.
    """
    before = file_states(*videos)
    try:
        yield partial(check_unchanged, before)
    except ColmapAv1Error:
        check_unchanged(before)
        raise
    check_unchanged(before)
