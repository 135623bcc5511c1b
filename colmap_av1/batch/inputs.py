"""The videos of a batch, found from lists, patterns, folders and URLs, and their names."""

from __future__ import annotations

import codecs
import glob
import os
import posixpath
import re
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import PurePosixPath

from colmap_av1.batch.output import HIDDEN, PAGE, ROWS
from colmap_av1.errors import OptionError
from colmap_av1.util.remote import (
    absolute,
    filesystem,
    is_url,
    open_to_read,
    unless_stalled,
    with_slashes,
    without_secrets,
)

# Files that a folder is searched for. Lists and patterns may name other files.
VIDEO_SUFFIXES = (
    ".mp4",
    ".m4v",
    ".mov",
    ".3gp",
    ".3g2",
    ".mkv",
    ".webm",
    ".ivf",
    ".obu",
    ".avi",
    ".wmv",
    ".flv",
    ".ts",
    ".m2ts",
    ".mts",
    ".mpg",
    ".mpeg",
    ".mxf",
    ".vob",
    ".ogv",
    ".h264",
    ".264",
    ".hevc",
    ".h265",
    ".265",
    ".y4m",
)
_SPECIAL = frozenset("*?[")
_OF_ROWS = re.compile(rf"{ROWS}(-\d+-of-\d+)?\.")
_LONGEST_LINE = 1 << 16
_LONGEST_PART = 240  # Bytes of a file name; file systems allow 255, and suffixes are appended.


@dataclass(frozen=True)
class Video:
    """A video of a batch.

    Attributes:
        name: path of its folder in the output, with '/' between parts.
        address: absolute path or URL.
    """

    name: str
    address: str


def list_videos(inputs: Sequence[str], output: str, stall: float) -> tuple[list[Video], int]:
    """The videos of a batch in the order given, and the number of repeated ones.

    An input is one of:

    - a folder, which is searched for videos in the order of their paths,
    - a pattern of file names,
    - a video,
    - any other file: a list with one video on each line, as a path relative to the list or a URL,
      optionally followed by a tab and a name; lines that start with '# ' are ignored.

    A video's default name is its path without suffix, relative to the folder, to the fixed part of
    the pattern or to the list's folder; for a video elsewhere it is the file name.

    Args:
        inputs: paths, patterns and URLs.
        output: absolute path or URL of the output, which must not lie in a searched folder.
        stall: seconds without data after which reading a URL fails.

    Raises:
        OptionError: a file does not exist, an input has no video, a list is not a text file, the
            output lies in a searched folder, or names clash or are not valid folder names.
        OSError: an input cannot be read.
    """
    videos: dict[str, Video] = {}
    num_repeated = 0
    for word in inputs:
        found = [Video(name, absolute(address)) for name, address in _listed(word, output, stall)]
        if not found:
            raise OptionError(
                f"{without_secrets(word)}: has no video: give a list, pattern or folder with one"
            )
        for video in found:
            _check_name(video)
            there = videos.setdefault(video.name, video)
            if there.address != video.address:
                raise OptionError(
                    f"{without_secrets(there.address)} and {without_secrets(video.address)} would "
                    f"both be '{video.name}' in the output: give a list with a tab and a unique "
                    "name after each"
                )
            num_repeated += there is not video
    folders = {str(folder) for name in videos for folder in PurePosixPath(name).parents}
    nested = next((name for name in videos if name in folders), None)
    if nested is not None:
        raise OptionError(
            f"'{nested}' is a video and the folder of others, so their outputs would mix: "
            "give a list with a tab and a unique name after each"
        )
    return list(videos.values()), num_repeated


def _check_name(video: Video) -> None:
    parts = video.name.split("/")
    unfit = {"", ".", ".."} & set(parts) or parts[0] in (HIDDEN, PAGE)
    unfit = unfit or _OF_ROWS.match(parts[0]) is not None or "\n" in video.name
    if unfit or any(len(os.fsencode(part)) > _LONGEST_PART for part in parts):
        raise OptionError(
            f"{without_secrets(video.address)}: '{video.name}' cannot be the name of its folder: "
            "give another name after a tab in a list"
        )


def _listed(word: str, output: str, stall: float) -> Iterable[tuple[str, str]]:
    """Names and addresses of the videos of one input."""
    word = word if is_url(word) else with_slashes(word)
    place = _Url(word, stall) if is_url(word) else _Local(word)
    if place.is_folder():
        root = absolute(word).rstrip("/")
        if f"{output.rstrip('/')}/".startswith(f"{root}/"):
            raise OptionError(
                f"{without_secrets(output)}: the output is in {without_secrets(word)}, which is "
                "searched for videos: give an output outside it"
            )
        return ((_name_below(address, root), address) for address in place.videos_below())
    if place.is_file():
        if _suffix_of(word) in VIDEO_SUFFIXES:
            return [(_name_below(word, os.path.dirname(word)), word)]
        return _of_list(word)
    if _SPECIAL & set(word):
        fixed = word[: next(i for i, letter in enumerate(word) if letter in _SPECIAL)]
        root = fixed.rpartition("/")[0]
        return ((_name_below(address, root), address) for address in place.matches())
    raise OptionError(
        f"{without_secrets(word)}: no such file or folder: give a list, pattern, folder or URL"
    )


def _name_below(address: str, root: str) -> str:
    """The path without suffix relative to a folder; the file name if it is not below it."""
    prefix = root if root.endswith("/") or not root else f"{root}/"
    below = address[len(prefix) :] if address.startswith(prefix) else ""
    if is_url(address):
        below, address = below.partition("?")[0], address.partition("?")[0]
    if not below or below.startswith("/") or is_url(below) or ".." in below.split("/"):
        below = address.rpartition("/")[2]
    return posixpath.splitext(posixpath.normpath(below))[0]


def _suffix_of(address: str) -> str:
    path = address.partition("?")[0] if is_url(address) else address
    return posixpath.splitext(path)[1].lower()


def _of_list(word: str) -> Iterator[tuple[str, str]]:
    """The videos on the lines of a list."""
    folder = word.rpartition("/")[0]
    with open_to_read(word) as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), b""), start=1):
            if len(line) == _LONGEST_LINE or b"\0" in line:
                raise OptionError(
                    f"{without_secrets(word)}: line {number} is not a path: give a text file "
                    "with one video on each line, or a video with a usual suffix such as .mp4"
                )
            mark = codecs.BOM_UTF8 if number == 1 else b""
            # File names need not be valid UTF-8.
            text = os.fsdecode(line.removeprefix(mark).rstrip(b"\r\n"))
            address, tab, name = text.partition("\t")
            if not address.strip() or address.startswith("# "):
                continue
            if not is_url(address) and folder and address[0] != "/":
                address = f"{folder}/{address}"
            yield name if tab else _name_below(address, folder), address


class _Local:
    """A path of this machine."""

    def __init__(self, path: str) -> None:
        self._path = path

    def is_folder(self) -> bool:
        return os.path.isdir(self._path)

    def is_file(self) -> bool:
        return os.path.isfile(self._path)

    def matches(self) -> list[str]:
        found = (p for p in glob.glob(self._path, recursive=True) if os.path.isfile(p))
        return sorted(map(with_slashes, found))

    def videos_below(self) -> Iterator[str]:
        for folder, folders, files in os.walk(os.path.abspath(self._path), onerror=_raise):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for name in sorted(files):
                if _is_video(name):
                    yield with_slashes(os.path.join(folder, name))


class _Url:
    """A URL."""

    def __init__(self, url: str, stall: float) -> None:
        self._url, self._stall = url, stall
        self._system, self._path = filesystem(url)

    def is_folder(self) -> bool:
        # Web servers have no folders: an address with a suffix is a file.
        if _suffix_of(self._url) or _SPECIAL & set(self._url):
            return False
        return bool(self._ask(self._system.isdir))

    def is_file(self) -> bool:
        return not _SPECIAL & set(self._url) and bool(self._ask(self._system.isfile))

    def matches(self) -> list[str]:
        return [self._system.unstrip_protocol(path) for path in self._paths(self._system.glob)]

    def videos_below(self) -> Iterator[str]:
        for path in self._paths(self._system.find):
            if _is_video(path.rpartition("/")[2]):
                yield str(self._system.unstrip_protocol(path))

    def _paths(self, list_paths: Callable[[str], Iterable[str]]) -> list[str]:
        return unless_stalled(lambda _: sorted(list_paths(self._path)), self._url, self._stall)

    def _ask(self, question: Callable[[str], object]) -> object:
        return unless_stalled(lambda _: question(self._path), self._url, self._stall)


def _is_video(name: str) -> bool:
    return not name.startswith(".") and _suffix_of(name) in VIDEO_SUFFIXES


def _raise(error: OSError) -> None:
    raise error
