"""Files at URLs, read through fsspec."""

from __future__ import annotations

import errno
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from colmap_av1.errors import ColmapAv1Error, OptionError, VideoError

_Result = TypeVar("_Result")

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_SECRET = re.compile(
    r"""([A-Za-z][A-Za-z0-9+.-]+:/{1,2})(?:[^\s/?@]*@)?([^\s?'"]*)(?:\?[^\s'"]*)?"""
)
_BLOCK = 1 << 22
# Keys of the tag or time of a version of an object: S3 and Azure, HTTP, Google.
_TAGS = ("ETag", "etag", "md5Hash", "LastModified", "last_modified", "mtime", "updated")
EXTRA = "colmap-av1[remote]"
_MISSING = (404, 410)  # HTTP status codes


def without_secrets(text: str) -> str:
    """The text with queries and passwords removed from its URLs: signed URLs contain secrets."""
    return _SECRET.sub(r"\1\2", text)


def is_url(address: str) -> bool:
    """Whether an address is a URL, not a local path."""
    return _URL.match(address) is not None


def absolute(address: str) -> str:
    """The URL or absolute path of an address, with "/" between its parts."""
    if address.startswith("file://"):
        address = address.removeprefix("file://")
    return address if is_url(address) else with_slashes(os.path.abspath(address))


def with_slashes(path: str) -> str:
    """A path of this machine with "/" between its parts, as Windows accepts, too."""
    return path.replace(os.sep, "/")


def filesystem(url: str) -> tuple[Any, str]:
    """The file system of fsspec for a URL, and the path in it.

    Raises:
        OptionError: a package is missing, or fsspec does not support this kind of URL.
    """
    shown = without_secrets(url)
    try:
        import fsspec  # noqa: PLC0415 - an optional dependency
    except ImportError as error:
        raise OptionError(f"{shown}: needs the package fsspec: pip install '{EXTRA}'") from error
    try:
        system, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        reason = without_secrets(str(error))
        raise OptionError(f"{shown}: {reason}: for S3, pip install '{EXTRA}'") from error
    except ValueError as error:
        reason = without_secrets(str(error))
        raise OptionError(
            f"{shown}: {reason}: give a path, or a URL that fsspec supports"
        ) from error
    return system, str(path)


def version_of(address: str, stall: float) -> dict[str, object]:
    """Facts that change with the content of a file: its size and time, or the tag of its store.

    Args:
        address: path or URL.
        stall: seconds without data after which reading a URL is given up.

    Raises:
        VideoError: the file does not exist.
        OSError: the file system does not answer.
    """
    if not is_url(address):
        try:
            status = os.stat(address)
        except FileNotFoundError as error:
            raise _missing(address) from error
        return {"bytes": status.st_size, "mtime_ns": status.st_mtime_ns}

    system, path = filesystem(address)

    def ask(_: Callable[[], None]) -> dict[str, object]:
        info = system.info(path)
        tags = {tag: str(info[tag]) for tag in _TAGS if info.get(tag) is not None}
        return {"bytes": info.get("size"), **tags}

    return unless_stalled(ask, address, stall)


def fetch(address: str, folder: Path, stall: float) -> Path:
    """The path of a file; a file at a URL is downloaded.

    Args:
        address: path or URL.
        folder: folder for the download.
        stall: seconds without data after which reading a URL is given up.

    Raises:
        VideoError: the file does not exist.
        OSError: the file cannot be read, or the download cannot be written.
    """
    if not is_url(address):
        return Path(address)
    target = folder / f"video{PurePosixPath(address.partition('?')[0]).suffix}"

    def copy(beat: Callable[[], None]) -> None:
        with open_to_read(address) as file, target.open("wb") as copied:
            while block := file.read(_BLOCK):
                copied.write(block)
                beat()

    unless_stalled(copy, address, stall)
    return target


def open_to_read(address: str) -> Any:
    """Open a path or URL to read bytes.

    Raises:
        OptionError: as `filesystem`.
        OSError: the file cannot be opened.
    """
    if not is_url(address):
        return open(address, "rb")
    system, path = filesystem(address)
    return system.open(path, "rb", block_size=_BLOCK)


def unless_stalled(
    step: Callable[[Callable[[], None]], _Result], address: str, seconds: float
) -> _Result:
    """Run a step that reads a URL; give it up if it makes no progress.

    Args:
        step: called with a function that it calls after each piece of progress.
        address: the URL, for messages.
        seconds: time without progress after which the step is given up.

    Raises:
        VideoError: the file does not exist.
        OSError: the step failed or stalled; a stalled step may continue in its thread.
        ColmapAv1Error: raised by the step.
    """
    result: list[_Result] = []
    failure: list[BaseException] = []
    last = [time.monotonic()]
    done = threading.Event()

    def beat() -> None:
        last[0] = time.monotonic()

    def run() -> None:
        try:
            result.append(step(beat))
        except BaseException as error:  # raised again below
            failure.append(error)
        finally:
            done.set()

    threading.Thread(target=run, daemon=True).start()
    while not done.wait(max(0.01, last[0] + seconds - time.monotonic())):
        if time.monotonic() - last[0] >= seconds:
            shown = without_secrets(address)
            raise OSError(errno.ETIMEDOUT, f"no data for {seconds:g} seconds", shown)
    if failure:
        raise _as_os_error(failure[0], address) from failure[0]
    return result[0]


def _as_os_error(error: BaseException, address: str) -> BaseException:
    """Convert an error of a store's client, which may have any type, to an OSError."""
    if isinstance(error, ColmapAv1Error) or not isinstance(error, Exception):
        return error
    if isinstance(error, FileNotFoundError):
        reason = _other_reason(error)
        if reason is None:
            return _missing(address)
        return OSError(errno.EIO, without_secrets(reason), without_secrets(address))
    if isinstance(error, OSError) and error.errno is not None:
        return error
    reason = next(iter(str(error).splitlines()), "") or type(error).__name__
    return OSError(errno.EIO, without_secrets(reason), without_secrets(address))


def _other_reason(error: FileNotFoundError) -> str | None:
    """Why a file was not found, if a server did not say that it is missing.

    fsspec raises this error for every answer of a web server but success, and if there is none.
    """
    status = getattr(error.__cause__, "status", None)
    if isinstance(status, int):
        return None if status in _MISSING else f"the server answers with HTTP status {status}"
    return str(error.__cause__) if isinstance(error.__cause__, OSError) else None


def _missing(address: str) -> VideoError:
    return VideoError(f"{without_secrets(address)}: no such file: give the path of a video")
