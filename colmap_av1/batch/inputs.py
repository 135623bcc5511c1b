"""The videos that are given as lists, patterns, folders, tar files and URLs, with their names."""

from __future__ import annotations

import glob
import os
import posixpath
import tarfile
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

from colmap_av1.batch.files import (
    filesystem,
    is_url,
    open_to_read,
    unless_stalled,
    without_secrets,
)
from colmap_av1.batch.jobs import Source
from colmap_av1.errors import OptionError

# What a folder or tar file is searched for; lists and patterns may name others.
VIDEO_SUFFIXES = frozenset(
    (
        *(".mp4", ".m4v", ".mov", ".3gp", ".mkv", ".webm", ".ivf", ".obu", ".avi", ".wmv", ".flv"),
        *(".ts", ".m2ts", ".mts", ".mpg", ".mpeg", ".y4m"),
    )
)
_TAR = ".tar"
_SPECIAL = frozenset("*?[")
_LONGEST_LINE = 1 << 16

Named = tuple[str, Source]


def list_videos(inputs: Sequence[str], output: str, stall: float) -> Iterator[Named]:
    """The videos of a batch in the order in which they are given, and a name for each.

    A folder is searched for videos and tar files, in the order of their paths; a pattern names
    files; any other file that is neither a video nor a tar file is a list: a line for each video,
    its path or URL, relative to the list, and if wanted a tab and its name. The name is the path
    without its suffix below the folder, the fixed part of the pattern or the folder of the list;
    of other files it is that of the file.

    Args:
        inputs: paths, patterns and URLs.
        output: the output, as an absolute path or URL, which no folder among them may hold.
        stall: seconds without data after which a URL is given up.

    Raises:
        OptionError: there is nothing of the name, no video, a list that is none, or the output is
            in a folder that is searched.
        OSError: something cannot be read.
    """
    for word in inputs:
        count = 0
        for named in _list_one(word, output, stall):
            count += 1
            yield named
        if count == 0:
            raise OptionError(
                f"{without_secrets(word)}: holds no video: give a list, pattern or folder with one"
            )


def _list_one(word: str, output: str, stall: float) -> Iterator[Named]:
    place = _Url(word, stall) if is_url(word) else _Local(word)
    if place.is_folder():
        root = place.address.rstrip("/") if is_url(word) else os.path.abspath(word)
        if f"{output.rstrip('/')}/".startswith(f"{root.rstrip('/')}/"):
            raise OptionError(
                f"{output}: the output is in {word}, which is searched for videos: give one outside"
            )
        yield from _named(place.videos_below(), root, stall)
    elif place.is_file():
        suffix = _suffix_of(word)
        if suffix == _TAR or suffix in VIDEO_SUFFIXES:
            yield from _named([word], os.path.dirname(word), stall)
        else:
            yield from _of_list(word, stall)
    elif _SPECIAL & set(word):
        fixed = word[: next(i for i, letter in enumerate(word) if letter in _SPECIAL)]
        yield from _named(place.matches(), fixed.rpartition("/")[0], stall)
    else:
        raise OptionError(
            f"{without_secrets(word)}: no such file or folder: give a list, pattern, folder or URL"
        )


def _named(addresses: Sequence[str] | Iterator[str], root: str, stall: float) -> Iterator[Named]:
    """Videos with their names below a folder; those in tar files each for itself."""
    for address in addresses:
        name = _name_below(address, root)
        if _suffix_of(address) == _TAR:
            yield from _members(address, name, stall)
        else:
            yield name, Source(address)


def _name_below(address: str, root: str) -> str:
    """The path without suffix below a folder; the file's name alone where it is elsewhere."""
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


def _members(address: str, name: str, stall: float) -> Iterator[Named]:
    """The videos in a tar file, as WebDataset lays them out."""

    def read(beat: Callable[[], None]) -> list[Named]:
        found = []
        try:
            with open_to_read(address) as file, tarfile.open(fileobj=file, mode="r:") as tar:
                for member in tar:
                    beat()
                    if member.isfile() and _suffix_of(member.name) in VIDEO_SUFFIXES:
                        stem = _name_below(member.name.lstrip("./"), "")
                        part = Source(address, member.name, member.offset_data, member.size)
                        found.append((f"{name}/{stem}", part))
        except tarfile.TarError as error:
            what = f"{without_secrets(address)}: no tar file, or damaged: {error}: give another"
            raise OptionError(what) from error
        return found

    yield from unless_stalled(read, address, stall)


def _of_list(word: str, stall: float) -> Iterator[Named]:
    """The videos on the lines of a list, which is read as it is needed."""
    folder = word.rpartition("/")[0]
    with open_to_read(word) as file:
        for number, line in enumerate(iter(lambda: file.readline(_LONGEST_LINE), b""), start=1):
            if len(line) == _LONGEST_LINE or b"\0" in line:
                raise OptionError(
                    f"{without_secrets(word)}: line {number} is no path: give a text file "
                    "with a line for each video, or a video by a name that ends as videos do"
                )
            # Names of files need not be valid text.
            address, tab, name = os.fsdecode(line.rstrip(b"\r\n")).partition("\t")
            if not address.strip():
                continue
            if not is_url(address):
                address = f"{folder}/{address}" if folder and address[0] != "/" else address
            if tab:
                if _suffix_of(address) == _TAR:
                    yield from _members(address, name, stall)
                else:
                    yield name, Source(address)
            else:
                yield from _named([address], folder, stall)


class _Local:
    """A path of this machine."""

    def __init__(self, word: str) -> None:
        self.address = word

    def is_folder(self) -> bool:
        return os.path.isdir(self.address)

    def is_file(self) -> bool:
        return os.path.isfile(self.address)

    def matches(self) -> Iterator[str]:
        return iter(sorted(p for p in glob.glob(self.address, recursive=True) if _is_file(p)))

    def videos_below(self) -> Iterator[str]:
        for folder, folders, files in os.walk(os.path.abspath(self.address), onerror=_raise):
            folders[:] = sorted(name for name in folders if not name.startswith("."))
            for name in sorted(files):
                if _is_wanted(name):
                    yield os.path.join(folder, name)


class _Url:
    """A URL."""

    def __init__(self, word: str, stall: float) -> None:
        self.address = word
        self._stall = stall
        self._system, self._path = filesystem(word)

    def is_folder(self) -> bool:
        # Of a web server, an address that looks like a file is none.
        if _suffix_of(self.address) or _SPECIAL & set(self.address):
            return False
        return unless_stalled(lambda _: bool(self._system.isdir(self._path)), *self._about)

    def is_file(self) -> bool:
        if _SPECIAL & set(self.address):
            return False
        return unless_stalled(lambda _: bool(self._system.isfile(self._path)), *self._about)

    def matches(self) -> Iterator[str]:
        found = unless_stalled(lambda _: sorted(self._system.glob(self._path)), *self._about)
        return map(self._url, found)

    def videos_below(self) -> Iterator[str]:
        found = unless_stalled(lambda _: sorted(self._system.find(self._path)), *self._about)
        return (self._url(path) for path in found if _is_wanted(path.rpartition("/")[2]))

    @property
    def _about(self) -> tuple[str, float]:
        return self.address, self._stall

    def _url(self, path: Any) -> str:
        return str(self._system.unstrip_protocol(path))


def _is_wanted(name: str) -> bool:
    suffix = _suffix_of(name)
    return not name.startswith(".") and (suffix == _TAR or suffix in VIDEO_SUFFIXES)


def _is_file(path: str) -> bool:
    return Path(path).is_file()


def _raise(error: OSError) -> None:
    raise error
