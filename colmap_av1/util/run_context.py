"""The state that all steps of a long run share: clock, progress, threads and seed."""

from __future__ import annotations

from dataclasses import dataclass, field

from colmap_av1.options import RunOptions
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.progress import Clock, Progress, no_progress


@dataclass(frozen=True)
class RunContext:
    """The state that all steps of a run share.

    Attributes:
        clock: measures the time of the stages.
        progress: called as the stages progress.
        num_threads: number of threads that a step may use; the result does not depend on it.
        seed: random seed.
    """

    clock: Clock = field(default_factory=Clock)
    progress: Progress = no_progress
    num_threads: int = field(default_factory=lambda: threads_or_cpus(None))
    seed: int = 0

    @classmethod
    def of(cls, run: RunOptions, progress: Progress = no_progress) -> RunContext:
        """The context of a run with these options, with a new clock."""
        return cls(Clock(), progress, threads_or_cpus(run.num_threads), run.seed)
