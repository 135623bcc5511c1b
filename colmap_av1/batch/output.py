"""The output of a batch: a folder for each video, complete once it holds `report.json`."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from colmap_av1.batch.rows import json_text
from colmap_av1.errors import OptionError, cannot_write
from colmap_av1.util.files import only_run, remove_leftovers, whole_file
from colmap_av1.util.remote import filesystem, is_url

# Marks the folder of a video as complete.
REPORT = "report.json"
# Names in the output that no video may have.
HIDDEN = ".batch"
ROWS, PAGE = "batch", "report.html"
# Lists our files in the folder of a video while they are written.
_UNFINISHED = ".unfinished"


class Output:
    """A folder of this machine, or one that it has mounted; paths in it have '/' between parts."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def read(self, path: str) -> bytes | None:
        """The content of a file; None if there is none."""
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
        """Move or copy a file of this machine here."""
        target = self._root / path
        target.parent.mkdir(parents=True, exist_ok=True)
        try:
            file.replace(target)
        except OSError as error:
            if error.errno != errno.EXDEV:  # the scratch is on another disk
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
        """Names at the top, sorted; none if there is no output yet."""
        return sorted(os.listdir(self._root)) if self._root.exists() else []

    @contextmanager
    def opened(self, shard: str) -> Iterator[None]:
        """Make the output if it is missing, and be alone with a shard of the videos.

        Raises:
            OptionError: it cannot be made, or another batch is at work on the shard.
        """
        lock = self._root / HIDDEN / f"{ROWS}{shard}.lock"
        try:
            lock.parent.mkdir(parents=True, exist_ok=True)
            lock.touch()
        except OSError as error:
            raise OptionError(cannot_write(self._root, error)) from error
        with only_run(lock) as alone:
            if not alone:
                raise OptionError(
                    f"{self._root}: another batch is at work in it: wait for its end, or give "
                    "another output"
                )
            yield


class StoreOutput(Output):
    """A folder of an object store, whose files appear one by one, each of them whole."""

    def __init__(self, address: str) -> None:
        self._system, self._top = filesystem(address.rstrip("/"))

    def read(self, path: str) -> bytes | None:
        """The content of a file; None if there is none."""
        with suppress(FileNotFoundError):
            return bytes(self._system.cat_file(f"{self._top}/{path}"))
        return None

    def write(self, path: str, content: bytes) -> None:
        """Write a file."""
        self._system.pipe_file(f"{self._top}/{path}", content)

    def take(self, file: Path, path: str) -> None:
        """Copy a file of this machine here."""
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
        """Names at the top, sorted; none if there is no output yet."""
        with suppress(FileNotFoundError):
            paths = self._system.ls(self._top, detail=False)
            return sorted(str(path).rpartition("/")[2] for path in paths)
        return []

    @contextmanager
    def opened(self, shard: str) -> Iterator[None]:
        """Nothing: stores have no locks, and of two that write a file the later one wins."""
        del shard
        yield


def output_at(address: str) -> Output:
    """The output at a path or URL."""
    return StoreOutput(address) if is_url(address) else Output(Path(address))


def publish(output: Output, folder: Path, name: str, report: dict[str, object]) -> None:
    """Move a finished folder into the output as that of a video, in place of an earlier one.

    Files that others have put there stay. The report is written last; until then a list of our
    files is there, so that a later run can finish what was stopped.

    Raises:
        OptionError: no batch has made what is there, or a file of others is in the way.
        OSError: it cannot be written.
    """
    sources = {p.relative_to(folder).as_posix(): p for p in folder.rglob("*") if p.is_file()}
    sources.pop(REPORT, None)  # the command's own, which `report` holds
    new = {*sources, REPORT}
    there = output.files(name)
    ours = _files_of_ours(output, name, there, new)
    output.write(f"{name}/{_UNFINISHED}", json_text(sorted(ours | new)))
    for path in sorted((ours - new | {REPORT}) & there):
        output.remove(f"{name}/{path}")
    for path, source in sorted(sources.items()):
        output.take(source, f"{name}/{path}")
    output.write(f"{name}/{REPORT}", json_text({**report, "files": sorted(new)}))
    output.remove(f"{name}/{_UNFINISHED}")


def earlier_report(output: Output, name: str) -> dict[str, Any] | None:
    """The report of a video that is done; None if there is none of a batch."""
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
    """The files of a video's folder that an earlier run wrote, as its report or list says.

    Raises:
        OptionError: no batch has made the folder, or a new file would replace one of others.
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
        listed = report.get("files", sorted(new))  # earlier versions kept no list
    if not isinstance(listed, list):
        raise OptionError(
            f"{name}: is there and not of a batch: give another output, or move it away"
        )
    # A list from elsewhere must not reach out of the folder: only what was found in it counts.
    ours = {_UNFINISHED, REPORT, *(path for path in listed if isinstance(path, str))} & there
    for path in sorted(there - ours):
        if any(path == n or path.startswith(f"{n}/") or n.startswith(f"{path}/") for n in new):
            raise OptionError(f"{name}/{path}: is in the way and not of a batch: move it away")
    return ours
