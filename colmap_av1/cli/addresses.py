"""Videos given by a URL: downloaded before a command and deleted after it."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from urllib.parse import unquote, urlsplit

from colmap_av1.cli.terminal import print_note, show_as
from colmap_av1.errors import OptionError
from colmap_av1.options import BatchOptions
from colmap_av1.util.remote import absolute, fetch, is_url, without_secrets


@contextmanager
def videos_at_hand(namespace: argparse.Namespace) -> Iterator[None]:
    """Download videos given by a URL, and replace the URLs by the files.

    URLs are read with fsspec, which the extra "remote" installs.

    Raises:
        OptionError: fsspec, or a package it needs for such a URL, is missing, or fsspec does not
            support the protocol.
        VideoError: there is no such file.
        OSError: the file cannot be read, the transfer stalls, or the disk is full.
    """
    given = getattr(namespace, "video", None)
    videos = given if isinstance(given, list) else [given]
    if not any(_is_remote(video) for video in videos):
        yield
        return
    with tempfile.TemporaryDirectory(prefix="colmap-av1-") as folder:
        found = [
            _fetched(video, Path(folder) / str(number), namespace.quiet)
            if _is_remote(video)
            else video
            for number, video in enumerate(videos)
        ]
        namespace.video = found if isinstance(given, list) else found[0]
        yield


def _is_remote(video: str | None) -> bool:
    return video is not None and is_url(video) and not Path(video).exists()


def _fetched(url: str, folder: Path, quiet: bool) -> str:
    """A copy of a video with its remote file name, by which its images may be named."""
    address = absolute(url)
    if not is_url(address):  # file managers copy addresses with %20 for spaces
        return address if Path(address).exists() else unquote(address)
    folder.mkdir()
    if not quiet:
        print_note(f"fetching {without_secrets(url)}")
    try:
        copy = fetch(address, folder, BatchOptions().stall)
    except OptionError as error:
        raise OptionError(f"{error}; or download it first, and give its path") from error
    name = PurePosixPath(unquote(urlsplit(url).path)).name
    path = str(copy.rename(folder / name) if name else copy)
    show_as(path, without_secrets(url))
    return path
