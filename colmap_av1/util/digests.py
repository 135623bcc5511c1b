"""Digests of inputs, options, code and products."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import os
import stat
import time
import zlib
from collections.abc import Iterable
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from colmap_av1.util.files import is_hidden

PACKAGE = Path(__file__).resolve().parents[1]
# Option fields that change only the run time, not the result. The threads of a mapper are not among
# them, because they change the last digits of the result.
WITHOUT_EFFECT = frozenset({"ReadOptions.num_threads", "RunOptions.num_threads"})
_CODE = {".py", ".so", ".pyd"}
# Packages whose estimates are part of a result.
_LIBRARIES = ("opencv-python-headless", "poselib", "pycolmap")
# A file that is written again within this time may keep its time stamps: FAT stores them in steps
# of 2 s.
_UNSURE_NS = 2_000_000_000
_BLOCK = 1 << 20


def file_digest(path: Path) -> str:
    """Digest of a file's content. A process reads an unchanged file only once.

    Raises:
        OSError: the file cannot be read.
    """
    status = path.stat()
    times = _sure_times(status)
    if times is None:
        return _read_digest(path)
    return _known_digest(path.absolute(), status.st_size, *times)


def digest_if_there(path: str | os.PathLike[str] | None) -> str | None:
    """Digest of a file that may be missing; None if it is missing or the path is None.

    Raises:
        OSError: the file cannot be read.
    """
    return file_digest(Path(path)) if path is not None and Path(path).is_file() else None


def digest_of_tree(path: str | os.PathLike[str] | None) -> list[tuple[str, str]]:
    """Path and digest of a file, or of all files in a folder that are not hidden.

    There are none if it is missing or None.

    Raises:
        OSError: a file cannot be read.
    """
    if path is None:
        return []
    root = Path(path)
    if root.is_file():
        return [("", file_digest(root))]
    files = {p.relative_to(root): p for p in root.rglob("*") if p.is_file()}
    return [
        (name.as_posix(), file_digest(files[name])) for name in sorted(files) if not is_hidden(name)
    ]


@functools.cache
def _known_digest(path: Path, *_: int) -> str:
    return _read_digest(path)


def _read_digest(path: Path) -> str:
    digest = hashlib.sha256()
    with path.open("rb") as file:
        while block := file.read(_BLOCK):
            digest.update(block)
    return digest.hexdigest()


def file_record(path: Path) -> dict[str, Any]:
    """A record for JSON, with which `is_as_recorded` detects changes of a file.

    Raises:
        OSError: the file cannot be read.
    """
    status = path.stat()
    return {
        "bytes": status.st_size,
        "times": _sure_times(status),
        "digest": file_digest(path),
    }


def is_as_recorded(path: Path, record: dict[str, Any]) -> bool:
    """Whether a file exists with the content that was recorded.

    Its content is read only if its time stamps differ, as those of a copy do, or were too recent
    when it was recorded, because reading all images of a long video takes long, above all from a
    network disk. One of the time stamps is that of the last status change, which programs cannot
    set, so that new content with an old modification time is detected, too.
    """
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode) or status.st_size != record["bytes"]:
            return False
        same_times: bool = _times(status) == record["times"]
        return same_times or file_digest(path) == record["digest"]
    except OSError:
        return False


def _times(status: os.stat_result) -> list[int]:
    return [status.st_mtime_ns, status.st_ctime_ns]


def _sure_times(status: os.stat_result) -> list[int] | None:
    """The time stamps of a file; None if they are so recent that a change may not alter them."""
    times = _times(status)
    return times if time.time_ns() - max(times) > _UNSURE_NS else None


@functools.cache
def code_digest(*folders: str) -> str:
    """Digest of the code in some folders of this package, compiled code included.

    Args:
        folders: paths in the package, whose content counts recursively; ".": the whole package.

    Raises:
        ValueError: the package has no such folder.
    """
    missing = next((f for f in folders if not (PACKAGE / f).is_dir()), None)
    if missing is not None:
        raise ValueError(f"{missing}: is not a folder of {PACKAGE}")
    files = {p for folder in folders for p in (PACKAGE / folder).rglob("*") if p.suffix in _CODE}
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(f"{path.relative_to(PACKAGE).as_posix()} {_read_digest(path)}\n".encode())
    return digest.hexdigest()


def package_version() -> str:
    """Version of the installed package."""
    return _version("colmap-av1") or "of a checkout"


@functools.cache
def library_versions() -> tuple[str | None, ...]:
    """Versions of the libraries whose estimates are part of a result; None: not known."""
    return tuple(_version(name) for name in _LIBRARIES)


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def digest_of(values: Iterable[Any], *, timed: bool = False) -> str:
    """Digest of the values that a result depends on, such as options, paths and numbers.

    Args:
        values: dataclasses, dictionaries, sequences and plain values. Option fields that have no
            effect on the result are ignored.
        timed: the result includes the run time, so all fields count.

    Raises:
        TypeError: a value has another type, whose values cannot be distinguished.
    """
    text = _spell(list(values), frozenset() if timed else WITHOUT_EFFECT)
    return hashlib.sha256(text.encode()).hexdigest()


def _spell(value: Any, excluded: frozenset[str]) -> str:
    """The value as text that differs for different values."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        kind = type(value).__name__
        names = (field.name for field in dataclasses.fields(value))
        fields = {name: getattr(value, name) for name in names if f"{kind}.{name}" not in excluded}
        return f"{kind}{_spell(fields, excluded)}"
    if isinstance(value, dict):
        items = sorted((_spell(k, excluded), _spell(v, excluded)) for k, v in value.items())
        return f"{{{','.join(f'{k}:{v}' for k, v in items)}}}"
    if isinstance(value, (list, tuple)):
        return f"[{','.join(_spell(v, excluded) for v in value)}]"
    if isinstance(value, os.PathLike):
        return repr(os.fspath(value))
    if value is None or type(value) in (bool, int, float, str):
        return repr(value)
    raise TypeError(f"{value!r}: give a plain value")


def seed_of(*words: int) -> int:
    """A random seed for one of many searches, independent of the other searches."""
    return zlib.crc32(repr(words).encode())
