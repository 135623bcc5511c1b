"""The output of a batch: a folder for each video, there whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from colmap_av1.batch.files import filesystem, is_url
from colmap_av1.errors import OptionError, cannot_write
from colmap_av1.util.files import only_run, remove_leftovers, whole_file

# Mark of completion of a video's folder.
REPORT = "report.json"
# Names in the output that no video may have.
HIDDEN = ".batch"
ROWS, PAGE = "batch", "report.html"
# Marks the folder of a video in an object store as one that is being written.
_UNFINISHED = ".unfinished"
# Where a process keeps what it has not finished.
_SCRATCH = ".colmap-av1-"
_LOCK = "lock"


class Output(Protocol):
    """Where a batch writes."""

    def read(self, path: str) -> bytes | None:
        """The content of a file; None where there is none."""
        ...

    def publish(self, folder: Path, name: str) -> None:
        """Make a folder that of a video, in place of an earlier one.

        It holds `report.json`; where it becomes visible file by file, that comes last.

        Raises:
            OptionError: there is something that no batch has made.
            OSError: it cannot be written.
        """
        ...

    def put(self, file: Path, path: str) -> None:
        """Copy a file, there whole or not at all."""
        ...

    def files(self, suffix: str) -> list[str]:
        """Names of the files at the top with a suffix, sorted."""
        ...

    def opened(self, shard: str) -> AbstractContextManager[None]:
        """Make what is needed before the first video, and be alone with a shard of them.

        Raises:
            OptionError: it cannot be made, or another batch is at work on the shard.
        """
        ...


def output_at(address: str) -> Output:
    """The output at a path or URL."""
    return _UrlOutput(address) if is_url(address) else _FolderOutput(Path(address))


def scratch_for(output: str, scratch: str | os.PathLike[str] | None) -> str:
    """Absolute path of the folder for unfinished work."""
    if scratch is not None:
        return os.path.abspath(scratch)
    return tempfile.gettempdir() if is_url(output) else os.path.join(output, HIDDEN)


@contextmanager
def scratch_of_process(scratch: str | os.PathLike[str]) -> Iterator[Path]:
    """A folder of this process among the scratch; those of killed processes are removed.

    Raises:
        OSError: it cannot be made.
    """
    remove_unused_scratch(scratch)
    os.makedirs(scratch, exist_ok=True)
    # Containers may share host name and process numbers: only a random name is unique.
    folder = Path(tempfile.mkdtemp(prefix=_SCRATCH, dir=scratch))
    try:
        new = folder / "new"
        with only_run(new):
            new.rename(folder / _LOCK)  # held before others can find it
            yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def remove_unused_scratch(scratch: str | os.PathLike[str]) -> None:
    """Remove the folders of `scratch_of_process` that ended processes left."""
    if os.name != "posix":  # elsewhere there is no lock that tells
        return
    for folder in Path(scratch).glob(f"{_SCRATCH}*"):
        if (folder / _LOCK).is_file():
            with suppress(OSError), only_run(folder / _LOCK) as unused:
                if unused:
                    shutil.rmtree(folder, ignore_errors=True)


def files_below(folder: Path) -> list[Path]:
    """All files below a folder, sorted."""
    return sorted(path for path in folder.rglob("*") if path.is_file())


def report_in(content: bytes | None) -> dict[str, Any] | None:
    """A report of this command; None where it is something else."""
    try:
        report = json.loads(content or b"")
    except ValueError:
        return None
    is_ours = isinstance(report, dict) and "key" in report and isinstance(report.get("row"), dict)
    return report if is_ours else None


class _FolderOutput:
    """A folder of this machine, or one that it has mounted."""

    def __init__(self, root: Path) -> None:
        self._root = root

    def read(self, path: str) -> bytes | None:
        try:
            return (self._root / path).read_bytes()
        except (FileNotFoundError, NotADirectoryError):
            return None

    def publish(self, folder: Path, name: str) -> None:
        target = self._root / name
        there = files_below(target) if target.is_dir() else [target] if target.exists() else []
        old = {path.relative_to(target).as_posix() for path in there}
        new = {path.relative_to(folder).as_posix() for path in files_below(folder)}
        ours = _files_of_ours(self, name, old, new)
        with scratch_of_process(self._root / HIDDEN) as staging:
            target.parent.mkdir(parents=True, exist_ok=True)
            whole = staging / "whole"
            try:
                folder.rename(whole)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                shutil.copytree(folder, whole)  # the scratch is on another disk
            if not old:
                if target.exists():
                    shutil.rmtree(target)  # folders without a file
                whole.rename(target)
                return
            # What users have put beside our files stays where it is, whenever this is stopped.
            mark = target / _UNFINISHED
            mark.write_text(json.dumps(sorted(ours | new)))
            (target / REPORT).unlink(missing_ok=True)
            for path in sorted((ours & old) - new - {REPORT, _UNFINISHED}):
                (target / path).unlink()
            for path in sorted(new, key=lambda p: (p == REPORT, p)):
                (target / path).parent.mkdir(parents=True, exist_ok=True)
                (whole / path).replace(target / path)
            mark.unlink()

    def put(self, file: Path, path: str) -> None:
        with whole_file(self._root / path) as partial:
            shutil.copyfile(file, partial)

    def files(self, suffix: str) -> list[str]:
        return sorted(p.name for p in self._root.glob(f"*{suffix}"))

    @contextmanager
    def opened(self, shard: str) -> Iterator[None]:
        hidden = self._root / HIDDEN
        try:
            hidden.mkdir(parents=True, exist_ok=True)
            with only_run(hidden / f"{ROWS}{shard}.lock") as alone:
                if not alone:
                    raise OptionError(
                        f"{self._root}: another batch is at work in it: wait for its end, or give "
                        "another output"
                    )
                remove_unused_scratch(hidden)
                for suffix in (".csv", ".json"):
                    remove_leftovers(self._root, f"{ROWS}{shard}{suffix}")
                yield
        except OSError as error:
            if error.filename is None or not Path(os.fsdecode(error.filename)).is_relative_to(
                hidden
            ):
                raise
            raise OptionError(cannot_write(self._root, error)) from error


class _UrlOutput:
    """A folder of an object store, whose files appear one by one, each of them whole."""

    def __init__(self, address: str) -> None:
        self._address = address.rstrip("/")
        self._system, self._root = filesystem(self._address)

    def read(self, path: str) -> bytes | None:
        try:
            content: bytes = self._system.cat_file(f"{self._root}/{path}")
            return content
        except FileNotFoundError:
            return None

    def publish(self, folder: Path, name: str) -> None:
        target = f"{self._root}/{name}"
        old: set[str] = set()
        with suppress(FileNotFoundError):
            old = {str(path) for path in self._system.find(target)}
        new = {path.relative_to(folder).as_posix() for path in files_below(folder)}
        there = {path.removeprefix(f"{target}/") for path in old}
        ours = _files_of_ours(self, name, there, new)
        mark = f"{target}/{_UNFINISHED}"
        self._system.pipe_file(mark, json.dumps(sorted(ours | new)).encode())
        if REPORT in there:
            self._system.rm_file(f"{target}/{REPORT}")
        for path in sorted((ours & there) - new - {REPORT, _UNFINISHED}):
            self._system.rm_file(f"{target}/{path}")
        for path in sorted(new, key=lambda p: (p == REPORT, p)):
            self._system.put_file(str(folder / path), f"{target}/{path}")
        self._system.rm_file(mark)

    def put(self, file: Path, path: str) -> None:
        self._system.put_file(str(file), f"{self._root}/{path}")

    def files(self, suffix: str) -> list[str]:
        paths = self._system.ls(self._root, detail=False)
        return sorted(n for p in paths if (n := str(p).rpartition("/")[2]).endswith(suffix))

    @contextmanager
    def opened(self, shard: str) -> Iterator[None]:
        del shard  # object stores have no locks; of two that write a file, the later one wins
        yield


def _files_of_ours(output: Output, name: str, there: set[str], new: set[str]) -> set[str]:
    """The files of a video's folder that an earlier run wrote, as its report or mark lists them.

    Raises:
        OptionError: no batch has made the folder, or a new file would replace one of a user.
    """
    if not there:
        return set()
    mark = output.read(f"{name}/{_UNFINISHED}")
    if mark is not None:
        try:
            listed: Any = json.loads(mark)
        except ValueError:  # stopped while it was written: nothing was changed before
            listed = [_UNFINISHED, *new]
    else:
        report = report_in(output.read(f"{name}/{REPORT}"))
        if report is None:
            raise OptionError(
                f"{name}: is there and not of a batch: give another output, or move it away"
            )
        # Reports of earlier versions have no list.
        listed = [REPORT, *report.get("files", new)]
    ours = {_UNFINISHED, REPORT, *(path for path in listed if isinstance(path, str))}
    # A list from elsewhere must not reach outside of the folder: only what was found in it counts.
    ours &= there
    for path in sorted(there - ours):
        if any(path == n or path.startswith(f"{n}/") or n.startswith(f"{path}/") for n in new):
            raise OptionError(f"{name}/{path}: is in the way and not of a batch: move it away")
    return ours
