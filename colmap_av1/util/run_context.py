"""What travels with every call of a long run: its clock, progress, threads and seed."""

from __future__ import annotations

from dataclasses import dataclass, field

from colmap_av1.options import RunOptions
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.progress import Clock, Progress, no_progress


@dataclass(frozen=True)
class RunContext:
    """What every step of a run shares.

    Attributes:
        clock: measures the time of the stages.
        progress: called as the stages go on.
        num_threads: threads a step may use. The result does not depend on it.
        seed: seed of the random numbers.
    """

    clock: Clock = field(default_factory=Clock)
    progress: Progress = no_progress
    num_threads: int = field(default_factory=lambda: threads_or_cpus(None))
    seed: int = 0

    @classmethod
    def of(
        cls, run: RunOptions, clock: Clock | None = None, progress: Progress = no_progress
    ) -> RunContext:
        """The context of a run with these options; None: a clock of its own."""
        clock = clock if clock is not None else Clock()
        return cls(clock, progress, threads_or_cpus(run.num_threads), run.seed)
