"""One attempt at one video: read, done, and published as a whole."""

from __future__ import annotations

import dataclasses
import errno
import json
import os
import shutil
import sqlite3
import time
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, cast

from colmap_av1.batch.files import fetch, is_url, state_of, without_secrets
from colmap_av1.batch.jobs import Ended, Job, Outcome, Row, Source, TooSmall, Work
from colmap_av1.batch.needs import estimated_needs, fits
from colmap_av1.batch.outputs import REPORT, files_below, output_at, report_in
from colmap_av1.batch.rows import plain, row_facts, row_of
from colmap_av1.batch.tasks import (
    TASKS,
    UNPUBLISHED,
    Made,
    depends_on,
    model_files,
    write_thumbnail,
)
from colmap_av1.errors import (
    BitstreamError,
    ColmapAv1Error,
    EncodeError,
    LimitError,
    ModelError,
    NotAv1Error,
    OptionError,
    VideoError,
)
from colmap_av1.util.cpus import cpu_seconds
from colmap_av1.util.digests import digest_of
from colmap_av1.video.container import read_file

# Failures of the system that may be gone at the next attempt.
_PASSING = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EIO, errno.ESTALE, errno.EAGAIN, errno.ENOMEM),
    *(errno.ETIMEDOUT, errno.ECONNRESET, errno.ECONNREFUSED, errno.ECONNABORTED, errno.EPIPE),
    *(errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EMFILE, errno.ENFILE, errno.ENOTCONN),
}
# Kinds of failures that come of the video or the options, the first that fits.
_REASONS: tuple[tuple[type[Exception], str], ...] = (
    (NotAv1Error, "not AV1"),
    (BitstreamError, "damaged"),
    (LimitError, "too large"),
    (VideoError, "unreadable"),
    (EncodeError, "not converted"),
    (ModelError, "no model"),
    (OptionError, "unfit"),
    (ColmapAv1Error, "unfit"),
)


def attempt(work: Work, job: Job, scratch: Path) -> Outcome:
    """Do the task on a video, unless its folder in the output is of the same video and options.

    Args:
        work: the task.
        job: the video.
        scratch: a folder for unfinished work; it is left empty.

    Returns:
        What became of it; whatever goes wrong is a row, but for the end of this process.
    """
    attempted = _Attempt(work, job, scratch)
    try:
        return attempted.run()
    except Exception as error:  # of one video: the others go on
        return attempted.failed(error)
    finally:
        attempted.clear()


class _Attempt:
    """An attempt and what it has found out so far."""

    def __init__(self, work: Work, job: Job, scratch: Path) -> None:
        self._work, self._job = work, job
        self._folder, self._copies = scratch / "output", scratch / "input"
        self._start, self._cpu = time.perf_counter(), cpu_seconds()
        self._found: dict[str, Any] = {}

    def run(self) -> Outcome:
        work, job, folder = self._work, self._job, self._folder
        for new in (folder, self._copies):
            new.mkdir()
        output = output_at(work.output)
        state = state_of(job.source, work.stall)
        models = _model_states(work, job)
        key = digest_of([state, [s for _, s in models], work.version, *depends_on(work)])
        kept = report_in(output.read(f"{job.name}/{REPORT}"))
        if kept is not None and kept["key"] == key:
            row = dataclasses.replace(
                row_of(kept["row"]), name=job.name, input=without_secrets(str(job.source))
            )
            return Ended(row, kept=True)
        if kept is not None and kept.get("task") != work.task:
            raise OptionError(f"{job.name}: is of another task: give another output")
        video = fetch(job.source, self._copies, work.stall)
        file = read_file(video)
        needs = estimated_needs(work, file)
        if not fits(needs, job.needs):
            return TooSmall(needs)
        self._found["video_seconds"] = file.duration
        model = _fetch_model(models, self._copies, work.stall)
        made = self._make(video, model)
        write_thumbnail(video, folder)
        for name in UNPUBLISHED:
            shutil.rmtree(folder / name, ignore_errors=True)
        row = self._row("done")
        report = {
            "key": key,
            "version": work.version,
            "input": {"path": without_secrets(str(job.source)), **state},
            "task": work.task,
            "options": plain(dataclasses.asdict(cast(Any, work.options))),
            "row": row_facts(row),
            "files": [p.relative_to(folder).as_posix() for p in files_below(folder)],
            "report": self._as_named(plain(dataclasses.asdict(made.report))),
        }
        (folder / REPORT).write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")
        output.publish(folder, job.name)
        return Ended(row)

    def failed(self, error: Exception) -> Ended:
        """The row of a failure, and whether another attempt may help."""
        text = " ".join(self._as_named(_line_of(error)).split())
        chain = list(_chain(error))
        starved = any(isinstance(e, MemoryError) for e in chain)
        passing = any(_is_passing(e) for e in chain)
        if starved:
            reason = "memory"
        elif passing or isinstance(error, OSError):
            reason = "reading or writing"
        else:
            reason = next((name for kind, name in _REASONS if isinstance(error, kind)), "defect")
        return Ended(
            dataclasses.replace(self._row("failed"), reason=reason, error=text),
            passing=starved or passing,
            starved=starved,
            # A stalled read or a defect leaves the process in a state that nobody knows.
            spent=starved or passing or reason == "defect",
        )

    def clear(self) -> None:
        """Remove what is unfinished."""
        for folder in (self._folder, self._copies):
            shutil.rmtree(folder, ignore_errors=True)

    def _make(self, video: Path, model: Path | None) -> Made:
        """Run the task; its figures and warnings are kept for the row."""
        with warnings.catch_warnings(record=True) as said:
            warnings.simplefilter("always", UserWarning)
            run = TASKS[self._work.task].run
            made = run(video, self._folder, self._work, model, self._job.needs.cores)
        lines = [str(w.message) for w in said if issubclass(w.category, UserWarning)]
        unique = dict.fromkeys(self._as_named([*lines, *made.warnings]))
        self._found |= {**made.figures, "warnings": tuple(unique)}
        return made

    def _row(self, state: Literal["done", "failed"]) -> Row:
        return Row(
            self._job.name,
            without_secrets(str(self._job.source)),
            state,
            seconds=round(time.perf_counter() - self._start, 3),
            cpu_seconds=round(cpu_seconds() - self._cpu, 3),
            **self._found,
        )

    def _as_named(self, value: Any) -> Any:
        """Texts without the paths of unfinished work, which are of no use afterwards."""
        if isinstance(value, dict):
            return {key: self._as_named(item) for key, item in value.items()}
        if isinstance(value, list):
            return [self._as_named(item) for item in value]
        if isinstance(value, str):
            for path in (*self._copies.glob("video*"), self._copies):
                value = value.replace(str(path), str(self._job.source))
            value = without_secrets(value.replace(str(self._folder), self._job.name))
        return value


def _model_states(work: Work, job: Job) -> list[tuple[Source, dict[str, Any]]]:
    """The files of the video's model and their states; none where the task needs no model."""
    if work.models is None:
        return []
    for paths in model_files(job.name):
        files = [Source(f"{work.models.rstrip('/')}/{path}") for path in paths]
        try:
            return [(file, state_of(file, work.stall)) for file in files]
        except VideoError:  # it has not this one
            continue
    raise ModelError(
        f"{work.models}: has no model of '{job.name}': give a folder with cameras, images and "
        f"points3D in {job.name}, {job.name}/sparse/0 or {job.name}/0"
    )


def _fetch_model(
    models: list[tuple[Source, dict[str, Any]]], copies: Path, stall: float
) -> Path | None:
    if not models:
        return None
    if not is_url(models[0][0].address):
        return Path(models[0][0].address).parent
    model = copies / "model"
    model.mkdir()
    for file, _ in models:
        name = file.address.rpartition("/")[2]
        fetch(file, model, stall).rename(model / name)
    return model


def _is_passing(error: BaseException) -> bool:
    if isinstance(error, sqlite3.OperationalError):
        return "full" in str(error) or "I/O" in str(error)
    return isinstance(error, OSError) and error.errno in _PASSING


def _chain(error: BaseException | None) -> Iterator[BaseException]:
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def _line_of(error: Exception) -> str:
    if isinstance(error, ColmapAv1Error):
        return str(error)
    if isinstance(error, OSError) and error.filename is not None:
        return f"{os.fsdecode(error.filename)}: {error.strerror}"
    if isinstance(error, MemoryError):
        return "out of memory"
    return f"{type(error).__name__}: {error}"
