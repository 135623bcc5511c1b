"""The output of a batch: a folder for each video, there whole or not at all."""

from __future__ import annotations

import errno
import json
import os
import shutil
import socket
import tempfile
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from pathlib import Path
from typing import Any, Protocol

from colmap_av1.batch.files import filesystem, free, is_url
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
OURS = f"colmap-av1-{socket.gethostname()}"


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
    folder = scratch_of(scratch, os.getpid())
    remove_leftovers(folder.parent, OURS)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def scratch_of(scratch: str | os.PathLike[str], process: int) -> Path:
    """The folder that a process of this machine has among the scratch."""
    return Path(scratch) / f".{OURS}.{process}.partial"


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
        if target.exists() and report_in(self.read(f"{name}/{REPORT}")) is None:
            _refuse_foreign(str(target), any(target.iterdir()) if target.is_dir() else True)
        staging = scratch_of(self._root / HIDDEN, os.getpid()) / "publish"
        staging.mkdir(parents=True)
        try:
            target.parent.mkdir(parents=True, exist_ok=True)
            whole = staging / "new"
            try:
                folder.rename(whole)
            except OSError as error:
                if error.errno != errno.EXDEV:
                    raise
                shutil.copytree(folder, whole)  # the scratch is on another disk
            if target.exists():
                target.rename(staging / "old")
            whole.rename(target)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
            free(staging.parent)

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
                remove_leftovers(hidden, OURS)
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
        mark = f"{target}/{_UNFINISHED}"
        if report_in(self.read(f"{name}/{REPORT}")) is None:
            _refuse_foreign(f"{self._address}/{name}", bool(old) and mark not in old)
        self._system.pipe_file(mark, b"")
        if f"{target}/{REPORT}" in old:
            self._system.rm_file(f"{target}/{REPORT}")
        new = [p for p in sorted(folder.rglob("*")) if p.is_file()]
        paths = {p: f"{target}/{p.relative_to(folder).as_posix()}" for p in new}
        for path in sorted(old - {mark, f"{target}/{REPORT}", *paths.values()}):
            self._system.rm_file(path)
        for file in sorted(new, key=lambda p: p == folder / REPORT):
            self._system.put_file(str(file), paths[file])
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


def _refuse_foreign(place: str, holds_things: bool) -> None:
    """Refuse to take the place of what no batch has made."""
    if holds_things:
        raise OptionError(
            f"{place}: is there and not of a batch: give another output, or move it away"
        )
