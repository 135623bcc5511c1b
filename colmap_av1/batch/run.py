"""A batch: every video of the inputs ends done, or named with the reason."""

from __future__ import annotations

import dataclasses
import os
import re
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, cast

from colmap_av1.batch.cluster import RayEngine
from colmap_av1.batch.files import absolute
from colmap_av1.batch.index import Index
from colmap_av1.batch.inputs import list_videos
from colmap_av1.batch.jobs import Ended, Engine, Job, Needs, Outcome, Row, TooSmall, Work
from colmap_av1.batch.local import LocalEngine
from colmap_av1.batch.needs import least_needs
from colmap_av1.batch.outputs import (
    ROWS,
    Output,
    output_at,
    scratch_for,
    scratch_of_process,
)
from colmap_av1.batch.rows import write_csv, write_json
from colmap_av1.batch.tasks import matching_of, task_of
from colmap_av1.errors import OptionError, cannot_write
from colmap_av1.options import BatchOptions, DensifyOptions
from colmap_av1.options.fields import Options
from colmap_av1.util.digests import package_version

# Rows are written at most so often, and for at most this share of the time: those of a million
# videos take half a minute.
_WRITE_EVERY = 5.0
_WRITE_SHARE = 0.05
_WAIT = 1.0
_GB = 10**9
_TASK = re.compile(rb'^ "task": "([a-z]+)"', re.MULTILINE)


@dataclass
class Counts:
    """How far a batch is.

    Attributes:
        total: videos of this shard.
        done: those that are done, by this or an earlier run.
        kept: those of them that an earlier run had finished.
        failed: those that failed, by reason.
        retried: attempts beyond the first.
    """

    total: int
    done: int = 0
    kept: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    retried: int = 0

    @property
    def ended(self) -> int:
        """Videos that are done or failed."""
        return self.done + self.failed.total()


@dataclass(frozen=True)
class BatchReport:
    """What became of a batch.

    Attributes:
        output: the output, as an absolute path or URL.
        num_videos: videos of this shard.
        num_done: those that are done.
        num_kept: those of them that an earlier run had finished.
        failed: numbers of failed videos by reason.
        num_retried: attempts beyond the first.
        seconds: wall time.
        cpu_seconds: CPU time of the attempts by which this run has done videos.
        video_seconds: length of these videos.
        warnings: what the user should know.
    """

    output: str
    num_videos: int
    num_done: int
    num_kept: int
    failed: dict[str, int]
    num_retried: int
    seconds: float
    cpu_seconds: float
    video_seconds: float
    warnings: tuple[str, ...]


Watch = Callable[[Counts, "Row | None"], None]


def run_batch(
    inputs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    task: Options,
    *,
    models: str | os.PathLike[str] | None = None,
    options: BatchOptions | None = None,
    hear: Callable[[str], None] | None = None,
    watch: Watch | None = None,
) -> BatchReport:
    """Do one task on many videos.

    Each video gets a folder in the output, with `report.json` as its mark of completion; it is
    there whole or not at all. `batch.csv` and `batch.json` there have a row for each
    video, in the order of the inputs, and are written as it goes. Videos whose folder comes of the
    same file, options and version are kept from an earlier run; others are made again, and so is
    what failed.

    Args:
        inputs: lists, patterns, folders and files, see `list_videos`; paths or URLs.
        output: folder or URL.
        task: options of the task, whose type says which it is: those of `reconstruct`, `match`,
            `densify` or, `ReadOptions`, `info`.
        models: of `densify`: folder or URL that has a model for each video, under its name.
        options: where the videos are processed, and what becomes of those that fail.
        hear: is told what the videos are processed on.
        watch: called at the start and whenever a video has ended, with its row.

    Raises:
        OptionError: the inputs or options cannot work, or nothing can be written.
        OSError: the inputs cannot be read.
    """
    options = options if options is not None else BatchOptions()
    words = [inputs] if isinstance(inputs, (str, os.PathLike)) else inputs
    place = absolute(os.fspath(output))
    work = _work_of(task, place, None if models is None else os.fspath(models), options)
    shard = "" if options.shard is None else "-{}-of-{}".format(*options.part)
    start = time.perf_counter()
    with ExitStack() as opened:
        into = output_at(place)
        opened.enter_context(into.opened(shard))
        _refuse_another_task(into, place, work.task)
        try:
            scratch = opened.enter_context(scratch_of_process(work.scratch))
        except OSError as error:
            raise OptionError(cannot_write(Path(work.scratch), error)) from error
        index = Index(scratch / "index.db")
        opened.callback(index.close)
        index.add(list_videos([os.fspath(word) for word in words], place, options.stall))
        counts = Counts(_size_of(options.part, index.num_videos))
        rows = _RowFiles(index, into, work, shard, scratch)
        engine: Engine = LocalEngine(work) if options.engine == "local" else _ray(work, options)
        opened.callback(engine.close)
        if hear is not None:
            hear(engine.about)
        jobs = index.jobs(options.part, least_needs(work))
        totals = [0.0, 0.0]
        watch = watch if watch is not None else _watch_nothing
        watch(counts, None)
        try:
            for job, ended in _drive(jobs, engine, options.retries, counts):
                index.record(job.position, ended.row)
                if not ended.kept and ended.row.state == "done":
                    totals[0] += ended.row.cpu_seconds or 0.0
                    totals[1] += ended.row.video_seconds or 0.0
                watch(counts, ended.row)
                rows.write_in_time()
        except BaseException:
            with suppress(OptionError):
                rows.write()
            raise
        rows.write()
    return BatchReport(
        output=place,
        num_videos=counts.total,
        num_done=counts.done,
        num_kept=counts.kept,
        failed=dict(sorted(counts.failed.items())),
        num_retried=counts.retried,
        seconds=time.perf_counter() - start,
        cpu_seconds=totals[0],
        video_seconds=totals[1],
        warnings=_warnings(index),
    )


def _refuse_another_task(output: Output, place: str, task: str) -> None:
    """Refuse an output whose tables are those of another task.

    Raises:
        OptionError: they are.
    """
    with suppress(OSError):  # there is nothing yet
        for name in output.files(".json"):
            if name == f"{ROWS}.json" or name.startswith(f"{ROWS}-"):
                found = _TASK.search(output.read(name) or b"")
                if found is not None and found[1].decode() != task:
                    raise OptionError(
                        f"{place}: holds a batch of the task {found[1].decode()}: give another "
                        "output"
                    )


def _drive(
    jobs: Iterator[Job], engine: Engine, retries: int, counts: Counts
) -> Iterator[tuple[Job, Ended]]:
    """Attempt every video until it is done, or another attempt cannot help."""
    again: deque[Job] = deque()
    num_running = 0
    upcoming = next(jobs, None)
    while again or num_running or upcoming is not None:
        while (job := again[0] if again else upcoming) is not None and engine.has_room(job):
            engine.submit(job)
            num_running += 1
            if again:
                again.popleft()
            else:
                upcoming = next(jobs, None)
        for job, outcome in engine.wait(_WAIT):
            num_running -= 1
            further = _further_attempt(job, outcome, retries)
            if further is not None:
                counts.retried += further.attempt > job.attempt
                again.append(further)
                continue
            ended = cast(Ended, outcome)
            counts.done += ended.row.state == "done"
            counts.kept += ended.kept
            if ended.row.state == "failed":
                counts.failed[ended.row.reason] += 1
            yield job, ended


def _further_attempt(job: Job, outcome: Outcome, retries: int) -> Job | None:
    """The video as it is to be attempted again; None where it has ended."""
    if isinstance(outcome, TooSmall):
        return replace(job, needs=outcome.needs)
    if not outcome.passing or job.attempt > retries:
        return None
    memory = job.needs.memory * (2 if outcome.starved else 1)
    return replace(job, needs=Needs(job.needs.cores, memory), attempt=job.attempt + 1)


class _RowFiles:
    """The files of rows in the output, written again as rows come."""

    def __init__(self, index: Index, output: Output, work: Work, shard: str, scratch: Path) -> None:
        self._index, self._output, self._scratch = index, output, scratch
        self._names = [f"{ROWS}{shard}{suffix}" for suffix in (".csv", ".json")]
        self._facts = {
            "task": work.task,
            "options": dataclasses.asdict(cast(Any, work.options)),
            "version": work.version,
            "videos": index.num_videos,
        }
        self._next = 0.0

    def write_in_time(self) -> None:
        """Write the rows so far, unless that was done a short while ago, if that is possible."""
        if time.monotonic() >= self._next:
            with suppress(OptionError):
                self.write()

    def write(self) -> None:
        """Write the rows so far.

        Raises:
            OptionError: they cannot be written.
        """
        start = time.monotonic()
        self._next = start + _WRITE_EVERY
        files = [self._scratch / name for name in self._names]
        try:
            write_csv(self._index.rows(), files[0])
            write_json(self._index.rows(), files[1], self._facts)
            for file in files:
                self._output.put(file, file.name)
        except OSError as error:
            path = Path(os.fsdecode(error.filename or self._names[0]))
            raise OptionError(cannot_write(path, error)) from error
        end = time.monotonic()
        self._next = end + max(_WRITE_EVERY, (end - start) / _WRITE_SHARE)


def _work_of(task: Options, output: str, models: str | None, options: BatchOptions) -> Work:
    """What is done with each video, after a look at what cannot work."""
    name = task_of(task)
    if (models is not None) != isinstance(task, DensifyOptions):
        what = "is for" if models is not None else "is missing for"
        raise OptionError(f"models {what} the task densify: give a folder of models with it alone")
    matching = matching_of(task)
    if matching is not None and matching.keep_stream is not None:
        raise OptionError("keep_stream is one file, and a batch has many videos: leave it out")
    return Work(
        task=name,
        options=task,
        output=output,
        models=None if models is None else absolute(models),
        scratch=scratch_for(output, options.scratch),
        timeout=options.timeout,
        stall=options.stall,
        write_images=options.write_images,
        cores=options.cores,
        memory=None if options.memory is None else int(options.memory * _GB),
        version=package_version(),
    )


def _ray(work: Work, options: BatchOptions) -> Engine:
    return RayEngine(work, options.address)


def _size_of(part: tuple[int, int], total: int) -> int:
    number, count = part
    return len(range(number - 1, total, count))


def _warnings(index: Index) -> tuple[str, ...]:
    if not index.num_duplicates:
        return ()
    return (f"{index.num_duplicates} of the inputs are there twice and count once",)


def _watch_nothing(counts: Counts, row: Row | None) -> None:
    del counts, row
