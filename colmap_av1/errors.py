"""Errors of input: one class each, one base class.

Every message is one line that says what to do. The command line prints it and
exits with status 2; anything that is not a `ColmapAv1Error` is a defect of this
package.
"""

from __future__ import annotations

from pathlib import Path


class ColmapAv1Error(Exception):
    """Base class of every error this package raises for bad input."""


class VideoError(ColmapAv1Error):
    """The video file is missing, unreadable, or holds no video stream."""


class NotAv1Error(VideoError):
    """The video stream is not AV1; the message says how to convert it."""


class BitstreamError(ColmapAv1Error):
    """The AV1 bitstream is damaged or violates the specification."""


class LimitError(ColmapAv1Error):
    """The stream declares sizes above the limit given by the options."""


class ImageError(ColmapAv1Error):
    """The image folder does not fit the video (count, names, size, content)."""


class DatabaseError(ColmapAv1Error):
    """The database is locked, not a COLMAP database, or does not fit the video."""


class HlocError(ColmapAv1Error):
    """A file of hloc's features or matches is missing, unreadable, or contradicts itself."""


class EncodeError(ColmapAv1Error):
    """No AV1 encoder works, it fails, or the stream cannot be written."""


class ModelError(ColmapAv1Error):
    """The COLMAP model is missing, unreadable, without poses, or not of this video."""


class OptionError(ColmapAv1Error):
    """An option has a value that cannot work."""


class EvaluationError(ColmapAv1Error):
    """A front-end or a mapper that is compared failed; the message says where its log is."""


def cannot_write(path: Path, error: Exception) -> str:
    """The message where the system refuses to write a file or folder."""
    reason = getattr(error, "strerror", None) or error
    return f"{path}: cannot be written: {reason}: fix that, or give another path"
