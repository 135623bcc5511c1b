"""Read text files that users write, with one entry per line, and show their text in messages."""

from __future__ import annotations

import codecs
import errno
import os
import unicodedata
from collections.abc import Sequence
from pathlib import Path, PurePath

from colmap_av1.errors import ImageError

# In bytes; lists of frames, images or poses are much smaller.
_LARGEST = 1 << 28
# Number of characters that a message shows of a text.
_MOST_SHOWN = 40
# Number of names that a message shows.
_MOST_NAMED = 4
# Unicode's categories of characters that control a terminal or end a line, and the characters that
# change the direction of text.
_CONTROLS = ("Cc", "Zl", "Zp")
_DIRECTIONS = frozenset("\u200e\u200f\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
_UTF_16 = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)


def excerpt(text: str, most: int = _MOST_SHOWN) -> str:
    """The start of a text for a message, without characters that control a terminal."""
    return "".join(c if c.isprintable() else "?" for c in text[:most])


def on_one_line(text: str) -> str:
    """The text with line ends, tabs and other control characters replaced by escapes."""
    return "".join(_escaped(c) if _is_control(c) else c for c in text)


def _is_control(character: str) -> bool:
    return unicodedata.category(character) in _CONTROLS or character in _DIRECTIONS


def _escaped(character: str) -> str:
    return character.encode("unicode_escape").decode()


def some_names(names: Sequence[str]) -> str:
    """The first names of a list for a message."""
    listed = [f"'{name}'" for name in names[:_MOST_NAMED]]
    return ", ".join([*listed, "..."] if len(names) > _MOST_NAMED else listed)


def read_lines(path: str | os.PathLike[str]) -> list[str]:
    """Read the lines of a text file in UTF-8, or in UTF-16 with a byte order mark.

    Raises:
        OSError: the file cannot be read, is larger than any list, or is not a regular file: a pipe
            can be read only once, and a device may have no end.
        UnicodeDecodeError: the file has another encoding.
    """
    path = Path(path)
    if path.exists() and not path.is_file():
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "is a folder")
        raise OSError(errno.EINVAL, "is not a regular file: copy it to one first")
    if path.stat().st_size > _LARGEST:
        raise OSError(errno.EFBIG, "is too large")
    content = path.read_bytes()
    return content.decode("utf-16" if content.startswith(_UTF_16) else "utf-8-sig").splitlines()


def check_name(name: str) -> None:
    """Check that an image's name is a valid path of a file within the image folder.

    Raises:
        ImageError: the name leads out of the folder, or no file can have it.
    """
    parts = PurePath(name)
    if parts.anchor or ".." in parts.parts:  # on Windows also a drive
        raise ImageError(
            f"image {name!r} lies outside the image folder: give names within the folder"
        )
    if not parts.parts or "\0" in name:
        raise ImageError(f"image {name!r} has a name that no file can have: rename it")
    if name.encode(errors="replace").decode() != name:  # Python keeps other bytes as surrogates
        raise ImageError(
            f"image {name!r} has a name that is not UTF-8, which no database can hold: rename it"
        )
