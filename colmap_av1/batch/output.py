"""The output of a batch: a folder for each video, which is complete once it has `report.json`."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from colmap_av1.batch.rows import json_bytes
from colmap_av1.errors import OptionError, writing
from colmap_av1.util.files import REPORT, only_run, remove_leftovers, whole_file
from colmap_av1.util.remote import filesystem, is_url

# Names in the output that no video may use.
HIDDEN = ".batch"
ROWS, PAGE = "batch", "report.html"
# Lists this package's files in a video's folder while they are being written.
_UNFINISHED = ".unfinished"


class Output:
    """An output on a local or mounted file system. Paths in it use '/'."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def read(self, path: str) -> bytes | None:
        """The content of a file; None if it does not exist."""
        try:
            return (self._root / path).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def write(self, path: str, content: bytes) -> None:
        """Write a file, whole or not at all."""
        target = self._root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(target) as partial:
            partial.write_bytes(content)

    def take(self, file: Path, path: str) -> None:
        """Move or copy a local file into the output."""
        target = self._root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            file.replace(target)
        except OSError as error:
            if error.errno != errno.EXDEV:  # EXDEV: the file is on another disk.
                raise
            with whole_file(target) as partial:
                shutil.copyfile(file, partial)

    def remove(self, path: str) -> None:
        """Remove a file."""
        (self._root / path).unlink(missing_ok=True)

    def files(self, folder: str) -> set[str]:
        """Paths of the files below a folder, relative to it."""
        top = self._root / folder
        if top.exists() and not top.is_dir():
            return {""}
        remove_leftovers(top)
        return {path.relative_to(top).as_posix() for path in top.rglob("*") if not path.is_dir()}

    def names(self) -> list[str]:
        """Names at the top level, sorted; empty if there is no output yet."""
        return sorted(os.listdir(self._root)) if self._root.exists() else []

    @contextmanager
    def opened(self, shard: str) -> Iterator[None]:
        """Create the output if it is missing, and lock a shard of the videos.

        Raises:
            OptionError: another batch has locked the shard, or one with another number of shards,
                which has some of the same videos, is at work.
            WriteError: the output cannot be created.
        """
        lock = self._root / HIDDEN / f"{ROWS}{shard}.lock"
        with writing(self._root):
            lock.parent.mkdir(parents=True, exist_ok=True)
            lock.touch()
        others = [lock.parent / name for name in self._other_locks(lock)]
        with only_run(lock) as alone, ExitStack() as opened:
            if not alone or not all([opened.enter_context(only_run(other)) for other in others]):
                raise OptionError(
                    f"{self._root}: another batch is writing to it: wait until it ends, or give "
                    "another output"
                )
            opened.close()
            yield

    def _other_locks(self, lock: Path) -> list[str]:
        """The locks of runs with another number of shards."""
        names = os.listdir(lock.parent)
        number = lock.name.rpartition("-of-")[2]
        return sorted(n for n in names if n.endswith(".lock") and n.rpartition("-of-")[2] != number)


class StoreOutput(Output):
    """An output in an object store, where files appear one by one, each complete."""

    def __init__(self, address: str) -> None:
        self._system, self._top = filesystem(address.rstrip("/"))

    def read(self, path: str) -> bytes | None:
        """The content of a file; None if it does not exist."""
        with suppress(FileNotFoundError):
            return bytes(self._system.cat_file(f"{self._top}/{path}"))
        return None

    def write(self, path: str, content: bytes) -> None:
        """Write a file."""
        self._system.pipe_file(f"{self._top}/{path}", content)

    def take(self, file: Path, path: str) -> None:
        """Copy a local file into the output."""
        self._system.put_file(str(file), f"{self._top}/{path}")

    def remove(self, path: str) -> None:
        """Remove a file."""
        self._system.rm_file(f"{self._top}/{path}")

    def files(self, folder: str) -> set[str]:
        """Paths of the files below a folder, relative to it."""
        top = f"{self._top}/{folder}"
        with suppress(FileNotFoundError):
            return {str(path).removeprefix(f"{top}/") for path in self._system.find(top)}
        return set()

    def names(self) -> list[str]:
        """Names at the top level, sorted; empty if there is no output yet."""
        with suppress(FileNotFoundError):
            paths = self._system.ls(self._top, detail=False)
            return sorted(str(path).rpartition("/")[2] for path in paths)
        return []

    @contextmanager
    def opened(self, shard: str) -> Iterator[None]:
        """Do nothing: object stores have no locks, and the last writer of a file wins."""
        del shard
        yield


def output_at(address: str) -> Output:
    """The output at a path or URL."""
    return StoreOutput(address) if is_url(address) else Output(Path(address))


def publish(output: Output, folder: Path, name: str, report: dict[str, object]) -> None:
    """Move a finished folder into the output as a video's folder, replacing an earlier result.

    Other files in that folder stay. The report is written last. Until then a list of this package's
    files is there, so that a later run can replace the result of an interrupted one.

    Raises:
        OptionError: the folder exists and no batch created it, or another file is in the way.
        OSError: it cannot be written.
    """
    sources = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    sources.pop(REPORT, None)  # Written by the command; `report` includes its content.
    new = {*sources, REPORT}
    there = output.files(name)
    ours = _files_of_ours(output, name, there, new)
    output.write(f"{name}/{_UNFINISHED}", json_bytes(sorted(ours | new)))
    for path in sorted((ours - new | {REPORT}) & there):
        output.remove(f"{name}/{path}")
    for path, source in sorted(sources.items()):
        output.take(source, f"{name}/{path}")
    output.write(f"{name}/{REPORT}", json_bytes({**report, "files": sorted(new)}))
    output.remove(f"{name}/{_UNFINISHED}")


def remove_list_of_unfinished(output: Output, name: str) -> None:
    """Remove the list of files from a finished video's folder, if a killed run has left it."""
    path = f"{name}/{_UNFINISHED}"
    if output.read(path) is not None:
        output.remove(path)


def earlier_report(output: Output, name: str) -> dict[str, Any] | None:
    """The report of a finished video; None if no batch has written one."""
    try:
        report = json.loads(output.read(f"{name}/{REPORT}") or b"")
    except (ValueError, RecursionError):
        return None
    is_ours = isinstance(report, dict) and "key" in report and "row" in report
    return report if is_ours else None


def scratch_for(output: str, scratch: str | os.PathLike[str] | None) -> str:
    """Absolute path of the folder for unfinished work."""
    if scratch is not None:
        return os.path.abspath(scratch)
    return tempfile.gettempdir() if is_url(output) else os.path.join(output, HIDDEN)


def _files_of_ours(output: Output, name: str, there: set[str], new: set[str]) -> set[str]:
    """The files of a video's folder that an earlier run wrote, by its report or list.

    Raises:
        OptionError: no batch created the folder, or a new file would replace a foreign file.
    """
    if not there:
        return set()
    unfinished = output.read(f"{name}/{_UNFINISHED}") if _UNFINISHED in there else None
    report = earlier_report(output, name)
    listed: Any = None
    if unfinished is not None:
        with suppress(ValueError, RecursionError):
            listed = json.loads(unfinished)
    elif report is not None:
        listed = report.get("files")
    if not isinstance(listed, list):
        raise OptionError(
            f"{name}: exists and was not created by a batch: give another output, or move it away"
        )
    # A manipulated list must not refer to files outside the folder: only count those found in it.
    ours = {_UNFINISHED, REPORT, *(path for path in listed if isinstance(path, str))} & there
    for path in sorted(there - ours):
        if any(path == n or path.startswith(f"{n}/") or n.startswith(f"{path}/") for n in new):
            raise OptionError(
                f"{name}/{path}: is in the way and was not created by a batch: move it away"
            )
    return ours
