"""Processing many videos: each is done, or reported as failed with the reason."""

from __future__ import annotations

import dataclasses
import json
import os
import queue
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

from colmap_av1.batch.engines import LocalEngine, RayEngine
from colmap_av1.batch.inputs import Video, list_videos
from colmap_av1.batch.output import ROWS, Output, output_at, scratch_for
from colmap_av1.batch.rows import Row, csv_of, json_of, row_of
from colmap_av1.batch.video import SCRATCH, Outcome, Work, failed_row
from colmap_av1.errors import OptionError, WriteError, cannot_write, writing
from colmap_av1.options import BatchOptions, DensifyOptions
from colmap_av1.options.batch import TASK_OPTIONS, match_options_of
from colmap_av1.options.fields import Options
from colmap_av1.util.digests import package_version
from colmap_av1.util.files import remove_leftovers
from colmap_av1.util.remote import absolute, without_secrets

# Seconds between writes of the rows, and the largest share of the time spent on writing them.
_WRITE_EVERY = 5.0
_WRITE_SHARE = 0.05
_WAIT = 1.0


@dataclass
class Counts:
    """Progress of a batch.

    Attributes:
        total: number of videos of this shard.
        done: number of videos that are done, by this or an earlier run.
        kept: number of videos that an earlier run has finished.
        failed: number of failed videos by reason.
        retried: number of attempts beyond the first.
    """

    total: int
    done: int = 0
    kept: int = 0
    failed: Counter[str] = field(default_factory=Counter)
    retried: int = 0

    @property
    def ended(self) -> int:
        """Number of videos that are done or failed."""
        return self.done + self.failed.total()


@dataclass(frozen=True)
class BatchReport:
    """Result of a batch.

    Attributes:
        output: the output, as an absolute path or URL, without secrets.
        num_videos: number of videos of this shard.
        num_done: number of videos that are done.
        num_kept: number of videos that an earlier run has finished.
        failed: number of failed videos by reason.
        num_retried: number of attempts beyond the first.
        seconds: wall time.
        cpu_seconds: CPU time of this run's successful attempts.
        video_seconds: duration of the videos that this run has processed.
        warnings: warnings for the user.
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


OnProgress = Callable[[Counts, "Row | None"], None]


def run_batch(
    inputs: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    output: str | os.PathLike[str],
    task: Options,
    *,
    models: str | os.PathLike[str] | None = None,
    options: BatchOptions = BatchOptions(),
    on_start: Callable[[str], None] | None = None,
    on_progress: OnProgress | None = None,
) -> BatchReport:
    """Run one task on many videos.

    Each video gets a folder in the output, which is complete once it has `report.json`.
    `batch.csv` and `batch.json` have a row for each video, in the order of the inputs, and are
    updated during the run. A video is skipped if an earlier run has finished it with the same file,
    options and version; all others, including failed ones, are processed again.

    Args:
        inputs: lists, patterns, folders and files, as paths or URLs, see `list_videos`.
        output: folder or URL.
        task: options of the task. Their type selects it: the options of `reconstruct`, `match` or
            `densify`, or `ReadOptions` for `info`.
        models: for `densify`: folder or URL with a model for each video, under its name.
        options: where the videos are processed, and how failures are handled.
        on_start: called once with a line about the resources in use.
        on_progress: called at the start, and with the row of each video when it has ended.

    Raises:
        OptionError: the inputs or options are invalid.
        WriteError: the output cannot be written.
        OSError: the inputs cannot be read.

    Examples:
        >>> from colmap_av1 import ReadOptions, run_batch
        >>> report = run_batch("my_videos", "my_batch", ReadOptions())  # `info` for each video
        >>> report.num_videos, report.num_done, report.failed
        (2, 1, {'unreadable': 1})
    """
    words = [inputs] if isinstance(inputs, (str, os.PathLike)) else inputs
    place = absolute(os.fspath(output))
    work = _work_of(task, place, None if models is None else os.fspath(models), options)
    number, count = options.part
    shard = "" if options.shard is None else f"-{number}-of-{count}"
    start = time.perf_counter()
    # Before the output is opened, so that wrong inputs leave none.
    listed, num_repeated = list_videos([os.fspath(word) for word in words], place, options.stall)
    with ExitStack() as opened:
        into = output_at(place)
        opened.enter_context(into.opened(shard))
        _refuse_another_task(into, place, work.task)
        _refuse_files_of_others(into, place, shard)
        _check_scratch(work.scratch)
        videos = listed[number - 1 :: count]
        engine = (
            LocalEngine(work, options, len(videos))
            if options.engine == "local"
            else RayEngine(work, options)
        )
        opened.callback(engine.close)
        if on_start is not None:
            on_start(engine.about)
        on_progress = on_progress if on_progress is not None else _ignore_progress
        facts = {
            "task": work.task,
            "options": dataclasses.asdict(cast(Any, work.options)),
            "version": work.version,
            "videos": len(listed),
        }
        rows: dict[int, Row] = {}
        earlier = _earlier_rows(into, shard, videos)
        next_time = 0.0
        counts = Counts(len(videos))
        on_progress(counts, None)
        cpu_seconds = video_seconds = 0.0
        try:
            for position, outcome in _outcomes(engine, videos):
                row = outcome.row
                rows[position] = row
                counts.retried += outcome.retried
                counts.kept += outcome.kept
                if row.state == "failed":
                    counts.failed[row.reason] += 1
                else:
                    counts.done += 1
                if row.state == "done" and not outcome.kept:
                    cpu_seconds += row.cpu_seconds or 0.0
                    video_seconds += row.video_seconds or 0.0
                on_progress(counts, row)
                before = time.monotonic()
                if before >= next_time:
                    with suppress(WriteError):
                        _write_rows(into, shard, rows, facts, earlier)
                    after = time.monotonic()
                    next_time = after + max(_WRITE_EVERY, (after - before) / _WRITE_SHARE)
        except BaseException:
            with suppress(WriteError):
                _write_rows(into, shard, rows, facts, earlier)
            raise
        _write_rows(into, shard, rows, facts)
    repeated = f"ignored {num_repeated} repeated inputs"
    return BatchReport(
        output=without_secrets(place),
        num_videos=counts.total,
        num_done=counts.done,
        num_kept=counts.kept,
        failed=dict(sorted(counts.failed.items())),
        num_retried=counts.retried,
        seconds=time.perf_counter() - start,
        cpu_seconds=cpu_seconds,
        video_seconds=video_seconds,
        warnings=(repeated,) if num_repeated else (),
    )


def batch_files(output: Output) -> list[str]:
    """Names of the JSON files of rows in an output."""
    names = [name for name in output.names() if name.endswith(".json")]
    return [name for name in names if name == f"{ROWS}.json" or name.startswith(f"{ROWS}-")]


def _refuse_another_task(output: Output, place: str, task: str) -> None:
    """Refuse an output that has the batch of another task.

    Raises:
        OptionError: the output has such a batch.
    """
    for name in batch_files(output):
        found: object = None
        with suppress(ValueError, RecursionError):  # A damaged file will be replaced.
            found = json.loads(output.read(name) or b"")
        earlier = found.get("task") if isinstance(found, dict) else None
        if isinstance(earlier, str) and earlier in TASK_OPTIONS and earlier != task:
            raise OptionError(
                f"{without_secrets(place)}: has a batch of the task {earlier}: give another output"
            )


def _refuse_files_of_others(output: Output, place: str, shard: str) -> None:
    """Check that existing tables in the output were written by a batch.

    Raises:
        OptionError: another program wrote a file with the name of a table.
    """
    table = output.read(f"{ROWS}{shard}.csv")
    is_ours = not table or table.startswith(csv_of([]).rstrip())
    facts = output.read(f"{ROWS}{shard}.json")
    # With our table, the JSON file is ours even if it is damaged.
    if facts is not None and not (table and is_ours):
        found: object = None
        with suppress(ValueError, RecursionError):
            found = json.loads(facts)
        is_ours = isinstance(found, dict) and {"task", "rows"} <= found.keys()
    if not is_ours:
        raise OptionError(
            f"{without_secrets(place)}: has a {ROWS}{shard}.csv or .json that was not created by a "
            "batch: give another output"
        )


def _check_scratch(scratch: str) -> None:
    """Create the folder for unfinished work, and remove leftovers of killed processes.

    Raises:
        WriteError: it cannot be created.
    """
    with writing(Path(scratch)):
        os.makedirs(scratch, exist_ok=True)
    remove_leftovers(Path(scratch), SCRATCH)


def _outcomes(
    engine: LocalEngine | RayEngine, videos: Sequence[Video]
) -> Iterator[tuple[int, Outcome]]:
    """The outcomes of all videos in the order in which they end, with their positions."""
    ended: queue.SimpleQueue[Future[Outcome]] = queue.SimpleQueue()
    positions: dict[Future[Outcome], int] = {}
    for position, video in enumerate(videos):
        future = engine.submit(video)
        positions[future] = position
        future.add_done_callback(ended.put)
    for _ in videos:
        future = _next(ended)
        position = positions[future]
        error = future.exception()
        if error is None:
            yield position, future.result()
        else:
            yield position, Outcome(failed_row(videos[position], engine.failure(error)))


def _next(ended: queue.SimpleQueue[Future[Outcome]]) -> Future[Outcome]:
    while True:
        with suppress(queue.Empty):
            return ended.get(timeout=_WAIT)  # Windows cannot interrupt a wait without timeout.


def _write_rows(
    output: Output,
    shard: str,
    rows: Mapping[int, Row],
    facts: Mapping[str, object],
    earlier: Mapping[int, Row] = {},
) -> None:
    """Write the rows so far, in the order of the videos.

    Args:
        output: the output of the batch.
        shard: part of the names of the files.
        rows: the rows of this run, by index of the video.
        facts: facts of this run.
        earlier: rows of an earlier run, which remain until this run has its own.

    Raises:
        WriteError: they cannot be written.
    """
    left = {i: row for i, row in earlier.items() if i not in rows}
    ordered = [row for _, row in sorted({**left, **rows}.items())]
    facts = {**facts, "time": time.time(), "earlier": [vars(row) for row in left.values()]}
    own = [row for _, row in sorted(rows.items())]
    name = f"{ROWS}{shard}"
    try:
        output.write(f"{name}.csv", csv_of(ordered))
        output.write(f"{name}.json", json_of(own, facts))
    except OSError as error:
        path = Path(os.fsdecode(error.filename or f"{name}.csv"))
        raise WriteError(cannot_write(path, error)) from error


def _earlier_rows(output: Output, shard: str, videos: Sequence[Video]) -> dict[int, Row]:
    """The rows of an earlier run by index of the video, until this run has its own."""
    try:
        found = json.loads(output.read(f"{ROWS}{shard}.json") or b"{}")
        by_name = {row.name: row for key in ("earlier", "rows") for row in map(row_of, found[key])}
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError):
        return {}
    return {i: by_name[video.name] for i, video in enumerate(videos) if video.name in by_name}


def _work_of(task: Options, output: str, models: str | None, options: BatchOptions) -> Work:
    """The work for each video.

    Raises:
        OptionError: the options conflict.
    """
    name = next((name for name, kind in TASK_OPTIONS.items() if type(task) is kind), None)
    if name is None:
        kinds = ", ".join(kind.__name__ for kind in TASK_OPTIONS.values())
        raise OptionError(f"{type(task).__name__} is not a task of a batch: give one of {kinds}")
    if (models is not None) != isinstance(task, DensifyOptions):
        what = "is for" if models is not None else "is missing for"
        raise OptionError(f"models {what} the task densify: give a folder of models with it only")
    matching = match_options_of(task)
    if matching is not None and matching.keep_stream is not None:
        raise OptionError("keep_stream is one file, but a batch has many videos: omit it")
    return Work(
        task=name,
        options=task,
        output=output,
        models=None if models is None else absolute(models),
        scratch=scratch_for(output, options.scratch),
        batch=options,
        version=package_version(),
    )


def _ignore_progress(counts: Counts, row: Row | None) -> None:
    del counts, row
