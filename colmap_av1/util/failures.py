"""Classify exceptions as kinds of failure, for tables of many videos."""

from __future__ import annotations

import errno
import os
import sqlite3
from collections.abc import Iterator
from dataclasses import dataclass

from colmap_av1.errors import (
    BitstreamError,
    ColmapAv1Error,
    EncodeError,
    LimitError,
    ModelError,
    NotAv1Error,
    VideoError,
    WriteError,
)

# System errors that the next attempt will meet again.
_PERMANENT = (
    FileExistsError,
    FileNotFoundError,
    IsADirectoryError,
    NotADirectoryError,
    PermissionError,
)
_PERMANENT_NUMBERS = (errno.EFBIG, errno.EINVAL, errno.ENAMETOOLONG)
# Failures that the video or the options cause. The first matching class is used.
_REASONS: tuple[tuple[type[Exception], str], ...] = (
    (NotAv1Error, "not AV1"),
    (BitstreamError, "damaged"),
    (LimitError, "too large"),
    (VideoError, "unreadable"),
    (EncodeError, "not converted"),
    (ModelError, "no model"),
    (WriteError, "reading or writing"),
    (ColmapAv1Error, "unfit"),
)


@dataclass(frozen=True)
class Failure:
    """Why a video failed.

    Attributes:
        reason: the kind of failure.
        message: one line.
        transient: whether another attempt may succeed.
    """

    reason: str
    message: str
    transient: bool = False


def failure_of(error: BaseException) -> Failure:
    """The failure that an exception represents."""
    chain = list(_chain(error))
    if any(isinstance(e, MemoryError) for e in chain):
        return Failure("memory", _line_of(error), transient=True)
    if any(_is_transient(e) for e in chain):
        return Failure("reading or writing", _line_of(error), transient=True)
    if isinstance(error, OSError):
        return Failure("reading or writing", _line_of(error))
    reason = next((name for kind, name in _REASONS if isinstance(error, kind)), "defect")
    return Failure(reason, _line_of(error))


def _is_transient(error: BaseException) -> bool:
    if isinstance(error, sqlite3.OperationalError):
        return "full" in str(error) or "I/O" in str(error)
    if not isinstance(error, OSError) or isinstance(error, _PERMANENT):
        return False
    return error.errno not in _PERMANENT_NUMBERS


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _line_of(error: BaseException) -> str:
    if isinstance(error, ColmapAv1Error):
        text = str(error)
    elif isinstance(error, OSError) and error.filename is not None:
        text = f"{os.fsdecode(error.filename)}: {error.strerror}"
    elif isinstance(error, MemoryError):
        text = "out of memory"
    else:
        text = f"{type(error).__name__}: {error}"
    return " ".join(text.split())
