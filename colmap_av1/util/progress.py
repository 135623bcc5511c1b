"""Progress of the stages of a long run, and the time they take."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from colmap_av1.util.cpus import cpu_seconds

# Called with the name of a stage, the amount done, and the total if it is known.
Progress = Callable[[str, int, "int | None"], None]

_Item = TypeVar("_Item")


def no_progress(stage: str, done: int, total: int | None) -> None:
    """A `Progress` that reports nothing."""
    del stage, done, total


def progress_in(progress: Progress, stage: str, total: int) -> Callable[[int], None]:
    """A function that reports the progress of a stage, given only the amount done."""
    return lambda done: progress(stage, done, total)


class Clock:
    """Time of named stages.

    The time of a stage that is measured inside another one is not part of the time of the latter.

    Attributes:
        seconds: wall time of each stage so far.
        cpu_seconds: CPU time, of all threads and of finished child processes.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}
        # Wall and CPU time measured so far, of all stages.
        self._measured = (0.0, 0.0)

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time the body takes to a stage. Only one thread may measure."""
        start, cpu_start = time.perf_counter(), cpu_seconds()
        before, cpu_before = self._measured
        try:
            yield
        finally:
            elapsed, cpu = time.perf_counter() - start, cpu_seconds() - cpu_start
            inside, cpu_inside = self._measured[0] - before, self._measured[1] - cpu_before
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed - inside
            self.cpu_seconds[stage] = self.cpu_seconds.get(stage, 0.0) + cpu - cpu_inside
            self._measured = (before + elapsed, cpu_before + cpu)

    def iterate(self, stage: str, items: Iterable[_Item]) -> Iterator[_Item]:
        """Yield from `items`, and add the time to produce them to a stage."""
        iterator = iter(items)
        self.seconds.setdefault(stage, 0.0)
        self.cpu_seconds.setdefault(stage, 0.0)
        while True:
            with self.measure(stage):
                try:
                    item = next(iterator)
                except StopIteration:
                    return
            yield item
