"""Write output files and folders safely: no overwriting by accident, no partial output.

An output is written to a hidden file or folder next to its final place, which the process locks.
A hidden file or folder that no process has locked was left by a killed process.
"""

from __future__ import annotations

import contextlib
import errno
import glob
import json
import os
import re
import secrets
import shutil
import socket
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePath
from typing import Any

from colmap_av1.errors import OptionError, cannot_write
from colmap_av1.util.signals import held_back

try:
    import fcntl
except ImportError:  # Windows has no fcntl
    fcntl = None  # type: ignore[assignment]

_Path = str | os.PathLike[str]

# Report of a run in its output folder. In a batch, it marks the folder of a video as complete.
REPORT = "report.json"
# Folder of intermediate results, in the output of a run and of each of its further models.
STAGES = ".stages"
# Locks of some cluster file systems are visible on one machine only, so each machine removes only
# its own leftovers.
_OURS = f"colmap-av1-{zlib.crc32(socket.gethostname().encode()) & 0xFFFF:04x}"


def is_hidden(path: PurePath) -> bool:
    """Whether a part of a relative path begins with a dot."""
    return any(part.startswith(".") for part in path.parts)


def output_of_model(model: Path) -> Path | None:
    """The output of `reconstruct` that a model belongs to; None if another program made it.

    The report of a further model, in OUTPUT/model_1/sparse/0, is in OUTPUT.
    """
    folder = model.resolve()
    if folder.parts[-2:] != ("sparse", "0"):
        return None
    own = folder.parents[1]
    outputs = [own, own.parent] if own.name.startswith("model_") else [own]
    return next((output for output in outputs if (output / REPORT).is_file()), None)


def read_output_report(output: Path) -> dict[str, Any]:
    """The report of `reconstruct` in its output, alone or in a batch.

    Raises:
        OSError: it cannot be read.
        ValueError: it is damaged.
    """
    found = json.loads((output / REPORT).read_text())
    report = found.get("report", found) if isinstance(found, dict) else None
    if not isinstance(report, dict):
        raise ValueError("no report")
    return report


def check_new_file(
    path: Path, inputs: Iterable[_Path | None] = (), *, overwrite: bool = False
) -> None:
    """Check, before a command begins its work, that it may write a file.

    Args:
        path: the file.
        inputs: input files, which are never overwritten; None: not given.
        overwrite: allow replacing an existing file that is not an input.

    Raises:
        OptionError: the file is an input, or it exists and must not be replaced.
    """
    if not os.path.lexists(path):
        return
    if path.exists() and not path.is_file():
        raise OptionError(f"{path}: exists and is not a file: give another output")
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
    """Check that `whole_folder` can write a folder, and remove what a killed run left of it.

    Args:
        path: the folder.
        own: pattern of paths in the folder that may be replaced.
        inputs: input files and folders, see `check_apart`.
        overwrite: allow replacing a folder that contains only such paths.

    Raises:
        OptionError: the folder exists and must not be replaced, contains an input, is a mount
            point, or cannot be created.
    """
    if path.exists() and not path.is_dir():
        raise OptionError(f"{path}: is a file: give a new folder")
    remove_leftovers(path.resolve().parent, path.resolve().name)
    if path.is_dir() and any(path.iterdir()):
        if not overwrite:
            raise OptionError(f"{path}: is not empty: give a new folder, or --overwrite")
        other = _other_file(path, own)
        if other is not None:
            raise OptionError(
                f"{path}: contains {other}, which is never replaced: give a new folder"
            )
    check_apart(path, inputs)
    check_creatable(path.resolve())
    if path.is_dir():
        _check_movable(path.resolve())


def _check_movable(path: Path) -> None:
    """Check that a hidden folder next to a folder can be moved into it.

    A bind mount has the device number of the folder above it, so only a move shows it.
    """
    try:
        with held_back(), _hidden_folder(path) as probe:
            probe.rename(path / probe.name).rename(probe)
    except OSError as error:
        if error.errno == errno.EXDEV:
            raise OptionError(f"{path}: is a mount point: give a folder inside it") from error
        raise OptionError(cannot_write(path, error)) from error


def check_creatable(path: Path) -> None:
    """Check that a file or folder can be created, with the folders above it.

    Raises:
        OptionError: it cannot be created.
    """
    above = next((folder for folder in path.absolute().parents if folder.exists()), path.absolute())
    if not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise OptionError(f"{path}: cannot be created in {above}: give another path")


def check_apart(output: Path, inputs: Iterable[_Path | None]) -> None:
    """Check that an output folder neither is nor contains an input.

    Raises:
        OptionError: it is or contains an input.
    """
    for given in inputs:
        if given is not None and Path(given).resolve().is_relative_to(output.resolve()):
            raise OptionError(f"{output}: is or contains the input {given}: give another folder")


def check_outside(output: Path, photos: _Path | None) -> None:
    """Check that an output folder does not lie in the folder of the photos, which is searched.

    Raises:
        OptionError: it does, or is the same folder.
    """
    if photos is not None and output.resolve().is_relative_to(Path(photos).resolve()):
        raise OptionError(
            f"{output}: lies in {photos}, which is searched for photos: give a folder outside it"
        )


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Write a file under a hidden name in its folder; it is renamed at the end of the body.

    If the body ends early, even by an interrupt, an existing file is unchanged and the hidden file
    is removed.

    Yields:
        The hidden path to write to.

    Raises:
        OSError: the file cannot be created or renamed, or another program wrote it meanwhile.
    """
    before = _version(path)
    with _held(
        path,
        make=lambda partial: partial.touch(exist_ok=False),
        how=os.O_RDWR,
        remove=lambda partial: partial.unlink(missing_ok=True),
    ) as partial:
        yield partial
        if _version(path) != before:
            raise OSError(errno.EEXIST, "another program wrote it meanwhile", str(path))
        partial.replace(path)


@contextmanager
def whole_folder(path: Path, own: re.Pattern[str] | None = None) -> Iterator[Path]:
    """Like `whole_file` for a folder that is missing or empty; its parents are created.

    Args:
        path: the folder.
        own: pattern of paths in a folder that is not empty, which are replaced; None: the folder
            is not replaced. If the process is killed while it replaces them, `remove_leftovers`
            restores the old or the new content.

    Yields:
        The hidden folder to write to.

    Raises:
        OSError: the folder cannot be created or renamed, or it contains other files at the end of
            the body. The new content is then kept in a folder next to it, which the message names.
    """
    path = path.resolve()
    with _hidden_folder(path) as partial:
        yield partial
        try:
            _put(partial, path, own)
        except OSError as error:  # the new content may be the work of hours
            kept = partial.with_name(partial.stem[1:])
            partial.rename(kept)
            reason = f"{error.strerror}, the new content is in {kept}"
            raise OSError(error.errno, reason, str(path)) from error


@contextmanager
def scratch_folder(next_to: Path) -> Iterator[Path]:
    """A hidden folder next to a file or folder; it exists while the body runs.

    The leftovers of killed runs are removed first.

    Args:
        next_to: the file or folder, which need not exist.

    Raises:
        OSError: the folder cannot be created.
    """
    next_to = next_to.resolve()
    remove_leftovers(next_to.parent, next_to.name)
    with _hidden_folder(next_to) as scratch:
        yield scratch


def remove_leftovers(folder: Path, name: str | None = None) -> None:
    """Remove the hidden files and folders that killed processes of this machine left behind.

    A folder that was being replaced gets its old or its new content, whichever is complete.

    Args:
        folder: the folder with the leftovers.
        name: name of the output file or folder; None: any.
    """
    pattern = f".{'*' if name is None else glob.escape(name)}.{_OURS}{'[0-9a-f]' * 8}"
    for old in glob.glob(f"{pattern}.old", root_dir=folder):
        _finish_exchange(folder / old)
    for before in glob.glob(f"{pattern}.before", root_dir=folder):
        _undo_exchange(folder / before)
    for leftover in glob.glob(f"{pattern}.partial", root_dir=folder):
        path = folder / leftover
        # Leftovers that cannot be removed are harmless.
        with _left(path) as is_left, contextlib.suppress(OSError):
            if is_left:
                shutil.rmtree(path) if _is_folder(path) else path.unlink()


def _put(partial: Path, path: Path, own: re.Pattern[str] | None) -> None:
    """Move a hidden folder to its place, unless another program wrote there meanwhile."""
    if not path.exists():
        partial.replace(path)
        return
    other = next((p.name for p in path.iterdir()), None) if own is None else _other_file(path, own)
    if other is not None:
        raise OSError(errno.EEXIST, f"another program wrote {other} meanwhile", str(path))
    with held_back():  # the folder itself stays, because it may be the user's current folder
        _exchange(path, partial)


def _other_file(folder: Path, own: re.Pattern[str]) -> str | None:
    """A file in a folder whose path does not match a pattern."""
    held = (p.relative_to(folder).as_posix() for p in folder.rglob("*") if not _is_folder(p))
    return next((name for name in held if not own.fullmatch(name)), None)


def _exchange(path: Path, partial: Path) -> None:
    """Replace the content of a folder.

    The old content is moved to the folder `.before`. When it is complete there, the folder is
    renamed to `.old`, and the new content is moved into place.
    """
    before, old = partial.with_suffix(".before"), partial.with_suffix(".old")
    before.mkdir()
    try:
        _move_entries(path, before)
        before.rename(old)
        _move_entries(partial, path)
    except BaseException:  # an interrupt may reach another thread first
        if old.exists():
            _move_entries(path, partial)
            old.rename(before)
        _move_entries(before, path)
        before.rmdir()
        raise
    partial.rmdir()
    shutil.rmtree(old, ignore_errors=True)


def _undo_exchange(before: Path) -> None:
    """Move the old content of a folder back."""
    with _left(before.with_suffix(".partial")) as is_left, contextlib.suppress(OSError):
        if is_left:
            _move_entries(before, _place_of(before))
            before.rmdir()


def _finish_exchange(old: Path) -> None:
    """Move the rest of the new content of a folder into place, and remove the old content."""
    partial = old.with_suffix(".partial")
    with _left(partial) as is_left, contextlib.suppress(OSError):
        if is_left and partial.exists():
            _move_entries(partial, _place_of(old))
            partial.rmdir()
        if is_left:
            shutil.rmtree(old)


def _place_of(hidden: Path) -> Path:
    """The final place of a hidden file or folder."""
    return hidden.with_name(hidden.name[1:].rpartition(f".{_OURS}")[0])


def _move_entries(source: Path, target: Path) -> None:
    for entry in source.iterdir():
        if os.path.lexists(target / entry.name):  # the user created it in the meantime
            raise OSError(errno.EEXIST, os.strerror(errno.EEXIST), str(target / entry.name))
        entry.replace(target / entry.name)


def _hidden(path: Path) -> Path:
    return path.with_name(f".{path.name}.{_OURS}{secrets.token_hex(4)}.partial")


@contextmanager
def _hidden_folder(path: Path) -> Iterator[Path]:
    with _held(
        path,
        make=lambda partial: partial.mkdir(parents=True),
        how=os.O_RDONLY,
        remove=lambda partial: shutil.rmtree(partial, ignore_errors=True),
    ) as partial:
        yield partial


@contextmanager
def _held(
    path: Path, make: Callable[[Path], None], how: int, remove: Callable[[Path], None]
) -> Iterator[Path]:
    """Create a hidden file or folder next to a path and lock it, if the system has locks.

    Before it is locked, another process may remove it as a leftover. It is then created again.

    Args:
        path: the path.
        make: creates the file or folder.
        how: flags to open it with.
        remove: removes it after the body, if it still exists.
    """
    while True:
        partial, descriptor, is_made = _hidden(path), None, False
        try:
            with held_back():  # an interrupt right after `make` must not leave the file
                make(partial)
                is_made = True
            if fcntl is None:
                yield partial
                return
            with contextlib.suppress(FileNotFoundError):
                descriptor = os.open(partial, how)
            if descriptor is not None and _lock(descriptor) and partial.exists():
                yield partial
                return
        finally:
            if is_made:
                remove(partial)
            if descriptor is not None:
                os.close(descriptor)


def _lock(descriptor: int) -> bool:
    """Lock an open file or folder; False if another process has locked it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:  # a file system without locks
        pass
    return True


@contextmanager
def _left(path: Path) -> Iterator[bool]:
    """Whether a hidden file or folder is a leftover, which the body then keeps locked.

    False if this cannot be determined.
    """
    if fcntl is None:
        yield False
        return
    how = os.O_RDONLY if _is_folder(path) else os.O_RDWR  # some file systems need it to lock
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
    """Lock a file while the body runs; yields False if another process has locked it.

    The system releases the lock even if this process is killed.

    Raises:
        OSError: the file cannot be created.
    """
    with lock.open("ab") as file:
        yield fcntl is None or _lock(file.fileno())


def may_read(path: Path) -> bool:
    """Whether this process has permission to read a file; also True if the file is missing."""
    if path.exists() and not path.is_file():  # opening a pipe would wait for another process
        return True
    try:
        path.open("rb").close()
    except PermissionError:
        return False
    except OSError:
        return True
    return True


def _version(path: Path) -> tuple[int, ...] | None:
    """Values that change when a file is replaced or written to; None if it does not exist."""
    try:
        status = path.lstat()
    except OSError:
        return None
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


def _is_folder(path: Path) -> bool:
    return path.is_dir() and not path.is_symlink()


def _is_same(one: Path, two: _Path) -> bool:
    try:
        return one.samefile(two)
    except OSError:  # one of them does not exist
        return False
