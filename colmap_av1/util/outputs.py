"""What a command may write over: its own earlier output, anything else only when told to.

An input is never written over, under whatever name it is given: links, hard links and names that
differ in case only on some disks are followed to the file.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from colmap_av1.errors import OptionError

_Path = str | os.PathLike[str]


def made_by(command: str) -> str:
    """What a file says of the command that wrote it, by which that one knows it again."""
    return f"made by colmap-av1 {command}"


def check_files(
    outputs: Iterable[Path],
    inputs: Iterable[_Path | None],
    *,
    is_own: Callable[[Path], bool] = lambda _: False,
    overwrite: bool = False,
) -> None:
    """Refuse files that a command must not write, before its work.

    Args:
        outputs: the files.
        inputs: files and folders that are read; None: not given.
        is_own: whether an existing file is an earlier output of the same command.
        overwrite: replace other files that exist, too.

    Raises:
        OptionError: an output is an input, or in the place of a file in a folder that is one;
            or it exists and must not be replaced.
    """
    given = _existing(inputs)
    for output in outputs:
        if not os.path.lexists(output):
            continue
        if output.is_dir() or (output.exists() and not output.is_file()):
            raise OptionError(f"{output}: exists and is no file: give another output")
        own = is_own(output)
        for path in given:
            if _is_same(output, path) or (not own and _is_of_folder(output, path)):
                what = "is the input itself" if _is_same(output, path) else f"is read, in {path}"
                raise OptionError(f"{output}: {what}: give another output")
        if not (own or overwrite):
            raise OptionError(f"{output}: exists: give another output, or --overwrite")


def check_folder(output: Path, inputs: Iterable[_Path | None]) -> None:
    """Refuse a folder that a command must not fill or replace.

    Args:
        output: the folder.
        inputs: files and folders that are read; None: not given.

    Raises:
        OptionError: it is an input, or holds one.
    """
    for path in (Path(given) for given in inputs if given is not None):
        # Where a link lies, and where it leads.
        ends = (path.parent.resolve() / path.name, path.resolve())
        places = [place for end in ends for place in (end, *end.parents)]
        if output.resolve() in places or any(_is_same(output, place) for place in places):
            raise OptionError(f"{output}: is or holds the input {path}: give another folder")


def _existing(inputs: Iterable[_Path | None]) -> list[Path]:
    return [Path(path) for path in inputs if path is not None and os.path.exists(path)]


def _is_same(one: Path, two: Path) -> bool:
    try:
        return one.samefile(two)
    except OSError:  # one is not there
        return False


def _is_of_folder(file: Path, folder: Path) -> bool:
    """Whether a file lies in a folder or below it, or has another name there."""
    if not folder.is_dir():
        return False
    place = file.parent.resolve()
    if any(_is_same(folder, above) for above in (place, *place.parents)):
        return True
    status = file.stat() if file.exists() else None
    if status is None or (status.st_nlink == 1 and not file.is_symlink()):
        return False
    return any(_is_same(file, other) for other in _files_below(folder, status.st_ino))


def _files_below(folder: Path, inode: int) -> Iterator[Path]:
    """Files of a number, and links, which may lead to it."""
    for above, _, _ in os.walk(folder):
        with os.scandir(above) as entries:
            yield from (Path(e.path) for e in entries if e.is_symlink() or e.inode() == inode)
