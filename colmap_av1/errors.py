"""Errors for bad input, with one base class.

Every message is one line, "cause: remedy". The command line prints it and exits with status 2.
Any other exception is a defect of this package.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class ColmapAv1Error(Exception):
    """Base class of every error this package raises for bad input."""


class VideoError(ColmapAv1Error):
    """The video file is missing, unreadable, or has no video stream."""


class NotAv1Error(VideoError):
    """The video stream is not AV1; the message gives the command that converts it."""


class BitstreamError(ColmapAv1Error):
    """The AV1 bitstream is damaged or violates the specification."""


class LimitError(ColmapAv1Error):
    """The stream declares sizes above the limit given by the options."""


class ImageError(ColmapAv1Error):
    """The images do not match the video (count, names, size, content)."""


class DatabaseError(ColmapAv1Error):
    """The database is locked, not a COLMAP database, or does not match the video."""


class HlocError(ColmapAv1Error):
    """A file of hloc's features or matches is missing, unreadable, or inconsistent."""


class EncodeError(ColmapAv1Error):
    """No AV1 encoder works, it fails, or there is no place for the stream."""


class ModelError(ColmapAv1Error):
    """The COLMAP model is missing, unreadable, without poses, or not of this video."""


class WriteError(ColmapAv1Error):
    """An output cannot be written, for example because the disk is full."""


class OptionError(ColmapAv1Error):
    """An option has an invalid value."""


class EvaluationError(ColmapAv1Error):
    """A compared front-end or a mapper failed; the message names its log."""


def cannot_write(path: Path, error: Exception) -> str:
    """Message for a file or folder that the system refuses to write."""
    reason = getattr(error, "strerror", None) or error
    return f"{path}: cannot be written: {reason}: fix that, or give another path"


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Raise `WriteError` if the system refuses to write a file or folder.

    Args:
        path: what is written within the context, for the message.
    """
    try:
        yield
    except OSError as error:
        raise WriteError(cannot_write(path, error)) from error
