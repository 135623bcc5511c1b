"""Text files that users write, one entry a line, and texts of files in messages."""

from __future__ import annotations

import codecs
import os
from pathlib import Path, PurePosixPath

from colmap_av1.errors import ImageError

# No list of frames, images or poses comes near it.
_LARGEST = 1 << 28
# Characters of a text that a message shows.
_MOST_SHOWN = 40
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def shown(text: str) -> str:
    """The start of a text of a file, for messages: without what would steer a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:_MOST_SHOWN])


def read_lines(path: str | os.PathLike[str]) -> list[str]:
    """The lines of a text in UTF-8, or in UTF-16 with its mark of the order of bytes.

    Raises:
        OSError: it cannot be read, is larger than any list, or no regular file: a pipe gives what
            it holds once only, and a device may have no end.
        UnicodeDecodeError: it is no such text.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        what = "is a folder" if path.is_dir() else "is no regular file: copy it to one first"
        raise OSError(None, what)
    if path.stat().st_size > _LARGEST:
        raise OSError(None, "is too large")
    content = path.read_bytes()
    return content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig").splitlines()


def check_name(name: str) -> None:
    """Check that an image's name, its path within the image folder, is that of a file in it.

    Raises:
        ImageError: it leads out of the folder, or is none that a file can have.
    """
    parts = PurePosixPath(name)
    if parts.is_absolute() or ".." in parts.parts:
        raise ImageError(
            f"image {name!r} lies outside the image folder: give names within the folder"
        )
    if not parts.parts or "\0" in name:
        raise ImageError(f"image {name!r} has a name that no file can have: name it otherwise")
    if name.encode(errors="replace").decode() != name:  # Python holds other bytes as surrogates
        raise ImageError(
            f"image {name!r} has a name that is not UTF-8, which no database can hold: rename it"
        )
