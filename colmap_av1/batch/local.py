"""The engine of one machine: as many processes as its cores and memory allow."""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait

from colmap_av1.batch.jobs import Job, Outcome, Work
from colmap_av1.batch.worker import Worker
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.memory import usable_memory

_SHARE_OF_MEMORY = 0.9  # the rest is for the system, and what estimates are off by


class LocalEngine:
    """Processes of this machine; each attempts one video at a time, and may end alone.

    Attributes:
        about: what it runs on, a line for the user.
    """

    def __init__(self, work: Work) -> None:
        self._work = work
        self._cores = threads_or_cpus(None)
        self._memory = int(_SHARE_OF_MEMORY * usable_memory())
        self.about = f"{self._cores} cores and {self._memory / 1e9:.0f} GB of this machine"
        # Its threads only wait for processes, each for one, and live as long as these.
        self._threads = ThreadPoolExecutor(max_workers=self._cores)
        self._idle: list[Worker] = []
        self._workers: list[Worker] = []
        self._running: dict[Future[Outcome], tuple[Job, Worker]] = {}

    def has_room(self, job: Job) -> bool:
        """Whether what a video needs is free; all that there is, for one that needs more."""
        jobs = [running for running, _ in self._running.values()]
        cores = sum(other.needs.cores for other in jobs) + job.needs.cores
        memory = sum(other.needs.memory for other in jobs) + job.needs.memory
        return not jobs or (cores <= self._cores and memory <= self._memory)

    def submit(self, job: Job) -> None:
        """Attempt a video now."""
        if not self._idle:
            self._idle.append(Worker(self._work.scratch))
            self._workers.append(self._idle[-1])
        worker = self._idle.pop()
        self._running[self._threads.submit(worker.run, self._work, job)] = job, worker

    def wait(self, seconds: float) -> Sequence[tuple[Job, Outcome]]:
        """The attempts that have ended since, at least one unless none does in that time."""
        ended = wait(self._running, seconds, return_when=FIRST_COMPLETED).done
        outcomes = []
        for future in ended:
            job, worker = self._running.pop(future)
            self._idle.append(worker)
            outcomes.append((job, future.result()))
        return outcomes

    def close(self) -> None:
        """Stop all attempts at once."""
        for worker in self._workers:
            worker.close()
        self._threads.shutdown(wait=True, cancel_futures=True)
