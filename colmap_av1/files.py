"""Files that appear under their names only when whole."""

from __future__ import annotations

import contextlib
import glob
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


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes left of files that they wrote by `whole_file`.

    Args:
        folder: where the files are.
        name: of the file; None: any.
    """
    if os.name != "posix":  # elsewhere asking for a process may end it
        return
    names = "*" if name is None else glob.escape(name)
    for leftover in glob.glob(f".{names}.*.partial", root_dir=folder):
        writer = leftover.split(".")[-2]
        if writer.isdecimal() and not _is_running(int(writer)):
            with contextlib.suppress(OSError):  # what cannot be removed does no harm
                (folder / leftover).unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is someone else's
        pass
    return True
