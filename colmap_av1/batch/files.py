"""Reading of files here and, through fsspec, anywhere else."""

from __future__ import annotations

import errno
import os
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from colmap_av1.batch.jobs import Source
from colmap_av1.errors import ColmapAv1Error, OptionError, VideoError

_Result = TypeVar("_Result")

_URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+://")
_SECRET = re.compile(r"""([A-Za-z][A-Za-z0-9+.-]*://)(?:[^\s/?@]*@)?([^\s?'"]*)(?:\?[^\s'"]*)?""")
_BLOCK = 1 << 22
# What stores call the sign of a changed object: S3 and Azure, HTTP, Google.
_TAGS = ("ETag", "etag", "md5Hash", "LastModified", "last_modified", "mtime", "updated")
EXTRA = "colmap-av1[remote]"


def without_secrets(text: str) -> str:
    """The text with its URLs cut at the query and without passwords: signed URLs hold secrets."""
    return _SECRET.sub(r"\1\2", text)


def is_url(address: str) -> bool:
    """Whether an address is no path of this machine."""
    return _URL.match(address) is not None


def absolute(address: str) -> str:
    """The address for processes with another working folder."""
    if address.startswith("file://"):
        address = address.removeprefix("file://")
    return address if is_url(address) else os.path.abspath(address)


def filesystem(url: str) -> tuple[Any, str]:
    """The file system that fsspec has for a URL, and the path in it.

    Raises:
        OptionError: a package is missing, or there is no such kind of URL.
    """
    shown = without_secrets(url)
    try:
        import fsspec  # noqa: PLC0415 - few need it
    except ImportError as error:
        raise OptionError(f"{shown}: needs the package fsspec: pip install '{EXTRA}'") from error
    try:
        system, path = fsspec.core.url_to_fs(url, use_listings_cache=False)
    except ImportError as error:
        reason = without_secrets(str(error))
        raise OptionError(f"{shown}: {reason}: pip install '{EXTRA}' has those of S3") from error
    except ValueError as error:
        reason = without_secrets(str(error))
        raise OptionError(f"{shown}: {reason}: give a path, or a URL that fsspec knows") from error
    return system, str(path)


def state_of(source: Source, stall: float) -> dict[str, Any]:
    """What changes with the content of a video, as JSON holds it.

    Raises:
        VideoError: there is no such file.
        OSError: nothing can be learned of it.
    """
    part = {"start": source.start, "length": source.length} if source.member else {}
    if not is_url(source.address):
        try:
            status = os.stat(source.address)
        except FileNotFoundError as error:
            raise _missing(source.address) from error
        return {"bytes": status.st_size, "mtime_ns": status.st_mtime_ns, **part}

    system, path = filesystem(source.address)

    def ask(_: Callable[[], None]) -> dict[str, Any]:
        info = system.info(path)
        tags = {tag: str(info[tag]) for tag in _TAGS if info.get(tag) is not None}
        return {"bytes": info.get("size"), **tags, **part}

    return unless_stalled(ask, source.address, stall)


def fetch(source: Source, folder: Path, stall: float) -> Path:
    """A file that holds a video: its own, where it has one here, or a copy.

    Args:
        source: the video.
        folder: gets the copy.
        stall: seconds without data after which a URL is given up.

    Raises:
        VideoError: there is no such file.
        OSError: it cannot be read, or not be written here.
    """
    if not is_url(source.address) and not source.member:
        return Path(source.address)
    suffix = PurePosixPath(source.member or source.address.partition("?")[0]).suffix
    target = folder / f"video{suffix}"

    def copy(beat: Callable[[], None]) -> Path:
        with open_to_read(source.address) as file, target.open("wb") as copied:
            file.seek(source.start)
            left = source.length
            while left is None or left > 0:
                block = file.read(_BLOCK if left is None else min(_BLOCK, left))
                if not block:
                    break
                copied.write(block)
                left = left if left is None else left - len(block)
                beat()
        if left:
            raise VideoError(f"{source}: cut off: {left} bytes are missing: write the file again")
        return target

    return unless_stalled(copy, str(source), stall)


def open_to_read(address: str) -> Any:
    """An open file, of bytes, that can be read from any position.

    Raises:
        OptionError: as `filesystem`.
        OSError: it cannot be opened.
    """
    if not is_url(address):
        return open(address, "rb")
    system, path = filesystem(address)
    return system.open(path, "rb", block_size=_BLOCK)


def unless_stalled(
    step: Callable[[Callable[[], None]], _Result], address: str, seconds: float
) -> _Result:
    """Run a step that reads a URL; give it up where it does not come further.

    Args:
        step: is given a function to be called whenever it has come further.
        address: what it reads, for messages.
        seconds: for how long it may stand still.

    Raises:
        VideoError: there is no such file.
        OSError: it failed, or stood still; it may then run on as long as the process does.
        ColmapAv1Error: what the step raised.
    """
    shown = without_secrets(address)
    result: list[_Result] = []
    failure: list[BaseException] = []
    last = [time.monotonic()]
    done = threading.Event()

    def beat() -> None:
        last[0] = time.monotonic()

    def run() -> None:
        try:
            result.append(step(beat))
        except BaseException as error:  # handed on below
            failure.append(error)
        finally:
            done.set()

    threading.Thread(target=run, daemon=True).start()
    while not done.wait(max(0.01, last[0] + seconds - time.monotonic())):
        if time.monotonic() - last[0] >= seconds:
            raise OSError(errno.ETIMEDOUT, f"nothing comes for {seconds:g} seconds", shown)
    if failure:
        raise _as_os_error(failure[0], address) from failure[0]
    return result[0]


def _as_os_error(error: BaseException, address: str) -> BaseException:
    """What clients of stores raise, which is of many kinds, as one of the system."""
    if isinstance(error, ColmapAv1Error) or not isinstance(error, Exception):
        return error
    if isinstance(error, FileNotFoundError):
        return _missing(address)
    if isinstance(error, OSError) and error.errno is not None:
        return error
    reason = next(iter(str(error).splitlines()), "") or type(error).__name__
    return OSError(errno.EIO, without_secrets(reason), without_secrets(address))


def _missing(address: str) -> VideoError:
    return VideoError(f"{without_secrets(address)}: no such file: give the path of a video")
