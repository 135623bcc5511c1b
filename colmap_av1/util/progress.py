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
    """Time of named stages, in the order in which they first ran.

    Attributes:
        seconds: wall time of each stage so far.
        cpu_seconds: CPU time, of all threads and of finished child processes.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.cpu_seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        """Add the time the body takes to a stage."""
        start, cpu_start = time.perf_counter(), cpu_seconds()
        try:
            yield
        finally:
            elapsed, cpu = time.perf_counter() - start, cpu_seconds() - cpu_start
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed
            self.cpu_seconds[stage] = self.cpu_seconds.get(stage, 0.0) + cpu

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
