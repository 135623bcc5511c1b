"""Outputs: refused where something exists, written beside their place, one run in each.

What is being written lies in a hidden file or folder beside its place, which the process holds a
lock on. One that nobody holds was left by a killed process.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import os
import re
import secrets
import shutil
import socket
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from colmap_av1.errors import OptionError

try:
    import fcntl
except ImportError:  # there is none on Windows
    fcntl = None  # type: ignore[assignment]

_Path = str | os.PathLike[str]

# Some file systems of clusters have locks that only one machine knows: each cleans up after itself.
_OURS = f"colmap-av1-{zlib.crc32(socket.gethostname().encode()) & 0xFFFF:04x}"


def check_new_file(
    path: Path, inputs: Iterable[_Path | None] = (), *, overwrite: bool = False
) -> None:
    """Refuse a file that a command must not write, before its work.

    Args:
        path: the file.
        inputs: files that are read, which are never written over; None: not given.
        overwrite: replace another file that exists.

    Raises:
        OptionError: it is an input, or it exists and must not be replaced.
    """
    if not os.path.lexists(path):
        return
    if path.is_dir() or (path.exists() and not path.is_file()):
        raise OptionError(f"{path}: exists and is no file: give another output")
    if any(_is_same(path, given) for given in inputs if given is not None):
        raise OptionError(f"{path}: is the input itself: give another output")
    if not overwrite:
        raise OptionError(f"{path}: exists: give another output, or --overwrite")


def check_new_folder(
    path: Path,
    own: re.Pattern[str],
    inputs: Iterable[_Path | None] = (),
    *,
    overwrite: bool = False,
) -> None:
    """Refuse a folder that `whole_folder` could not make; remove what a killed run left of it.

    Args:
        path: the folder.
        own: paths of files in folders that may be replaced.
        inputs: files and folders that are read, see `check_apart`.
        overwrite: replace a folder that holds nothing else.

    Raises:
        OptionError: it is there and not empty, or nothing can be made where it is to be.
    """
    if path.exists() and not path.is_dir():
        raise OptionError(f"{path}: is a file: give a new folder")
    remove_leftovers(path.resolve().parent, path.resolve().name)
    if path.is_dir() and any(path.iterdir()):
        if not overwrite:
            raise OptionError(f"{path}: is there and not empty: give a new folder, or --overwrite")
        held = (p.relative_to(path).as_posix() for p in path.rglob("*") if not _is_folder(p))
        other = next((name for name in held if not own.fullmatch(name)), None)
        if other is not None:
            raise OptionError(f"{path}: holds {other}, which stays: give a new folder")
    check_apart(path, inputs)
    path = path.resolve()
    above = next(folder for folder in path.parents if folder.exists())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise OptionError(f"{path}: cannot be made in {above}: give another folder")


def check_apart(output: Path, inputs: Iterable[_Path | None]) -> None:
    """Refuse an output folder that is an input or holds one.

    Raises:
        OptionError: so it is.
    """
    for given in inputs:
        if given is not None and Path(given).resolve().is_relative_to(output.resolve()):
            raise OptionError(f"{output}: is or holds the input {given}: give another folder")


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A hidden name in the file's folder to write it under; it gets its own name at the end.

    Whatever ends the body early, an interrupt too, leaves the file as it was, and nothing
    beside it.

    Raises:
        OSError: the file cannot be given its name.
    """
    with _held(path, lambda partial: partial.touch(exist_ok=False), os.O_RDWR) as partial:
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
        overwrite: replace the content of one that is not empty, see `check_new_folder`. A process
            that is killed meanwhile loses neither the old nor the new content: `remove_leftovers`
            puts one of them in place.

    Raises:
        OSError: the folder cannot be made or given its name.
    """
    path = path.resolve()
    with _hidden_folder(path) as partial:
        yield partial
        if not path.exists():
            partial.replace(path)
        elif any(path.iterdir()) and not overwrite:
            raise OSError(errno.ENOTEMPTY, os.strerror(errno.ENOTEMPTY), str(path))
        else:  # the folder stays: it may be where the user is
            _exchange(path, partial)


@contextmanager
def scratch_folder(beside: Path) -> Iterator[Path]:
    """A hidden folder beside a file or folder, which need not exist, as long as the body runs.

    What a killed run left of its own there is removed first.

    Raises:
        OSError: it cannot be made.
    """
    beside = beside.resolve()
    remove_leftovers(beside.parent, beside.name)
    with _hidden_folder(beside) as scratch:
        yield scratch


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove what killed processes of this machine left of what they wrote by the functions above.

    A folder whose replacement was stopped gets its old or its new content, whichever is complete.

    Args:
        folder: where that is.
        name: of the file or folder; None: any.
    """
    pattern = f".{'*' if name is None else glob.escape(name)}.{_OURS}{'[0-9a-f]' * 8}"
    for old in glob.glob(f"{pattern}.old", root_dir=folder):
        _finish_exchange(folder / old)
    for before in glob.glob(f"{pattern}.before", root_dir=folder):
        _undo_exchange(folder / before)
    for leftover in glob.glob(f"{pattern}.partial", root_dir=folder):
        path = folder / leftover
        with _left(path) as is_left, contextlib.suppress(OSError):  # what stays does no harm
            if is_left:
                shutil.rmtree(path) if _is_folder(path) else path.unlink()


def _exchange(path: Path, partial: Path) -> None:
    """Replace a folder's content. Its old content lies in `.before` until it is all there.

    From then on it lies in `.old`, and the new content goes into the folder.
    """
    before, old = partial.with_suffix(".before"), partial.with_suffix(".old")
    before.mkdir()
    try:
        _move_entries(path, before)
        before.rename(old)
        _move_entries(partial, path)
    except OSError:
        if old.exists():
            _move_entries(path, partial)
            old.rename(before)
        _move_entries(before, path)
        before.rmdir()
        raise
    partial.rmdir()
    shutil.rmtree(old, ignore_errors=True)


def _undo_exchange(before: Path) -> None:
    """Put the old content of a folder back."""
    with _left(before.with_suffix(".partial")) as is_left, contextlib.suppress(OSError):
        if is_left:
            _move_entries(before, _place_of(before))
            before.rmdir()


def _finish_exchange(old: Path) -> None:
    """Put the rest of the new content of a folder in place, and remove the old one."""
    partial = old.with_suffix(".partial")
    with _left(partial) as is_left, contextlib.suppress(OSError):
        if is_left and partial.exists():
            _move_entries(partial, _place_of(old))
            partial.rmdir()
        if is_left:
            shutil.rmtree(old)


def _place_of(hidden: Path) -> Path:
    """The place that a hidden file or folder lies beside."""
    return hidden.with_name(hidden.name[1:].rpartition(f".{_OURS}")[0])


def _move_entries(source: Path, target: Path) -> None:
    for entry in source.iterdir():
        if os.path.lexists(target / entry.name):  # of a user, meanwhile
            raise OSError(errno.EEXIST, os.strerror(errno.EEXIST), str(target / entry.name))
        entry.replace(target / entry.name)


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.{_OURS}{secrets.token_hex(4)}.partial")


@contextmanager
def _hidden_folder(path: Path) -> Iterator[Path]:
    with _held(path, lambda partial: partial.mkdir(parents=True), os.O_RDONLY) as partial:
        try:
            yield partial
        finally:
            shutil.rmtree(partial, ignore_errors=True)


@contextmanager
def _held(path: Path, make: Callable[[Path], None], how: int) -> Iterator[Path]:
    """Make a hidden file or folder beside a path, and hold a lock on it, where there are locks.

    Until it is locked another process may take it for a leftover. Then it is made again.

    Args:
        path: the path.
        make: makes the file or folder.
        how: flags to open it with.
    """
    while True:
        partial = _hidden(path)
        make(partial)
        if fcntl is None:
            yield partial
            return
        try:
            descriptor = os.open(partial, how)
        except FileNotFoundError:
            continue
        try:
            if _lock(descriptor) and partial.exists():
                yield partial
                return
        finally:
            os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock an open file or folder; False where another process holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True


@contextmanager
def _left(path: Path) -> Iterator[bool]:
    """Whether nobody holds a hidden file or folder any more; the body then holds it.

    False where that cannot be known.
    """
    if fcntl is None:
        yield False
        return
    how = os.O_RDONLY if _is_folder(path) else os.O_RDWR  # as some file systems want it
    try:
        descriptor = os.open(path, how | os.O_NOFOLLOW)
    except OSError:
        yield not os.path.lexists(path)
        return
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            is_left = True
        except OSError:
            is_left = False
        yield is_left
    finally:
        os.close(descriptor)


@contextmanager
def only_run(lock: Path) -> Iterator[bool]:
    """Hold a file as long as the body runs; False where another process holds it.

    It is given back however this process ends.

    Raises:
        OSError: the file cannot be made.
    """
    with lock.open("ab") as file:
        yield fcntl is None or _lock(file.fileno())


def may_read(path: Path) -> bool:
    """Whether the system lets this process read a file; True where it is not there, too."""
    if path.exists() and not path.is_file():  # opening a pipe waits for another process
        return True
    try:
        path.open("rb").close()
    except PermissionError:
        return False
    except OSError:
        return True
    return True


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_same(one: Path, two: _Path) -> bool:
    try:
        return one.samefile(two)
    except OSError:  # one is not there
        return False
