"""Files and folders that appear under their names only when complete; one run in each."""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from colmap_av1.errors import OptionError

try:
    import fcntl
except ImportError:  # there is none on Windows
    fcntl = None  # type: ignore[assignment]


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden name in the file's folder to write it under; it gets its own name at the end.

    Whatever ends the body early, an interrupt too, leaves the file as it was, and nothing
    beside it.

    Raises:
        OSError: the file cannot be given its name.
    """
    partial = _partial(path)
    try:
        yield partial
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)


@contextmanager
def whole_folder(path: Path, *, overwrite: bool = False) -> Iterator[Path]:
    """The same for a folder, made with those above it, that does not exist yet or is empty.

    Args:
        path: the folder.
        overwrite: replace one that is not empty, see `check_new_folder`.

    Raises:
        OSError: the folder cannot be made or given its name.
    """
    path = path.resolve()
    partial, before = _partial(path), _partial(path.with_name(f"{path.name}.before"))
    try:
        partial.mkdir(parents=True)
        yield partial
        if not path.exists():
            partial.replace(path)
            return
        # The folder stays: it may be where a disk is mounted, or where the user is.
        if any(path.iterdir()) and not overwrite:
            raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY), str(path))
        before.mkdir()
        _move_entries(path, before)
        try:
            _move_entries(partial, path)
        except OSError:
            _move_entries(before, path)
            raise
    finally:
        shutil.rmtree(partial, ignore_errors=True)
        shutil.rmtree(before, ignore_errors=True)


def _move_entries(source: Path, target: Path) -> None:
    for entry in source.iterdir():
        entry.replace(target / entry.name)


@contextmanager
def scratch_folder(beside: Path) -> Iterator[Path]:
    """A hidden folder beside a file or folder, which need not exist, as long as the body runs.

    What a killed run left of its own there is removed first.

    Raises:
        OSError: it cannot be made.
    """
    beside = beside.resolve()
    remove_leftovers(beside.parent, beside.name)
    scratch = _partial(beside.with_name(f"{beside.name}.scratch"))
    # Of a process that had this one's number: it is gone, for this one has only begun.
    shutil.rmtree(scratch, ignore_errors=True)
    try:
        scratch.mkdir(parents=True)
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def check_new_folder(path: Path, own: re.Pattern[str], *, overwrite: bool = False) -> None:
    """Refuse a folder that `whole_folder` could not make; remove what a killed run left of it.

    Args:
        path: the folder.
        own: paths of files in folders that may be replaced.
        overwrite: replace a folder that holds nothing else.

    Raises:
        OptionError: it is there and not empty, or nothing can be made where it is to be.
    """
    if path.exists() and not path.is_dir():
        raise OptionError(f"{path}: is a file: give a new folder")
    if path.is_dir() and any(path.iterdir()):
        if not overwrite:
            raise OptionError(f"{path}: is there and not empty: give a new folder, or --overwrite")
        held = (p.relative_to(path).as_posix() for p in path.rglob("*") if not _is_folder(p))
        other = next((name for name in held if not own.fullmatch(name)), None)
        if other is not None:
            raise OptionError(f"{path}: holds {other}, which stays: give a new folder")
    path = path.resolve()
    above = next(folder for folder in path.parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise OptionError(f"{path}: cannot be made in {above}: give another folder")
    remove_leftovers(path.parent, path.name)


def may_read(path: Path) -> bool:
    """Whether the system lets this process read a file; True where it is not there, too."""
    try:
        path.open("rb").close()
    except PermissionError:
        return False
    except OSError:
        return True
    return True


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _partial(path: Path) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.partial")


@contextmanager
def only_run(lock: Path) -> Iterator[bool]:
    """Hold a file as long as the body runs; False where another process holds it.

    It is given back however this process ends.

    Raises:
        OSError: the file cannot be made.
    """
    with lock.open("ab") as file:
        held = True
        if fcntl is not None:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                held = False
            except OSError:  # a file system without locks
                pass
        yield held


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes left of what they wrote by `whole_file` and `whole_folder`.

    Args:
        folder: where that is.
        name: of the file or folder; None: any.
    """
    if os.name != "posix":  # elsewhere asking for a process may end it
        return
    names = "*" if name is None else glob.escape(name)
    for leftover in glob.glob(f".{names}.*.partial", root_dir=folder):
        writer = leftover.split(".")[-2]
        if writer.isdecimal() and not _is_running(int(writer)):
            path = folder / leftover
            with contextlib.suppress(OSError):  # what cannot be removed does no harm
                shutil.rmtree(path) if path.is_dir() else path.unlink()


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # it is someone else's
        pass
    return True
