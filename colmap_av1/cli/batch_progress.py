"""Progress of a batch: a bar on a terminal, otherwise a line from time to time."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.text import Text

from colmap_av1.batch.rows import Row
from colmap_av1.batch.run import Counts, OnProgress
from colmap_av1.cli.terminal import PROGRAM, print_note, print_warning
from colmap_av1.util.texts import on_one_line

_LINE_EVERY = 30.0  # seconds
# Largest number of failures that are printed; batch.csv lists all.
_MOST_LINES = 20


@contextmanager
def batch_progress(quiet: bool) -> Iterator[tuple[Callable[[str], None], OnProgress]]:
    """Callbacks for `run_batch` that print progress; failures are printed even if quiet."""
    if quiet or not sys.stderr.isatty():
        lines = _Lines(quiet)
        yield lines.on_start, lines.on_progress
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TextColumn("{task.fields[rate]}"),
        TextColumn("{task.fields[failed]}"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=Console(stderr=True)) as progress:
        bar = progress.add_task("videos", total=None, rate="", failed="")

        def show(text: str) -> None:
            progress.console.print(Text(on_one_line(f"{PROGRAM}: warning: {text}")))

        failures = _Failures(show)

        def on_progress(counts: Counts, row: Row | None) -> None:
            failures.show(row)
            speed = progress.tasks[bar].speed
            progress.update(
                bar,
                total=counts.total,
                completed=counts.ended,
                rate=f"{speed:.1f}/s" if speed else "",
                failed=_failed(counts),
            )

        yield (lambda about: progress.console.print(Text(about))), on_progress


class _Failures:
    """Prints the first failures."""

    def __init__(self, show: Callable[[str], None]) -> None:
        self._show = show
        self._num_shown = 0

    def show(self, row: Row | None) -> None:
        if row is None or row.state == "done" or self._num_shown > _MOST_LINES:
            return
        self._num_shown += 1
        if self._num_shown > _MOST_LINES:
            self._show("further failures are in batch.csv")
            return
        self._show(f"{row.name}: {row.reason}: {row.error}")


class _Lines:
    """Prints progress as lines, for log files."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._failures = _Failures(print_warning)
        self._start = self._last = time.monotonic()

    def on_start(self, about: str) -> None:
        if not self._quiet:
            print_note(about)

    def on_progress(self, counts: Counts, row: Row | None) -> None:
        self._failures.show(row)
        now = time.monotonic()
        if self._quiet or now - self._last < _LINE_EVERY:
            return
        self._last = now
        words = f"{counts.ended} of {counts.total} videos"
        rate = counts.ended / (now - self._start)
        if rate > 0:
            minutes = (counts.total - counts.ended) / rate / 60
            words += f", {rate:.2g} per second, {minutes:.0f} minutes left"
        failed = _failed(counts)
        print_note(f"{words}{failed and f', {failed}'}")


def _failed(counts: Counts) -> str:
    number = counts.failed.total()
    return f"{number} failed" if number else ""
