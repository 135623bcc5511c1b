"""The engine of a cluster: one task of Ray a video, on whatever node has what it needs."""

from __future__ import annotations

import logging
import os
import socket
import time
from collections.abc import Sequence
from typing import Any

from colmap_av1.batch.files import without_secrets
from colmap_av1.batch.jobs import Ended, Job, Outcome, Row, Work
from colmap_av1.batch.worker import Worker
from colmap_av1.errors import OptionError
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.signals import handlers_kept

EXTRA = "colmap-av1[cluster]"
# Tasks that Ray is given ahead of what it can run at a time: enough for every node to have a
# next one, and for clusters that grow with what waits.
_AHEAD = 3
_LEAST_AHEAD = 16
_LOOK = 10.0  # seconds between looks at the size of the cluster
_ANSWERS = 10.0  # seconds in which something must answer at an address

_worker: Worker | None = None


class RayEngine:
    """Tasks of a Ray that is started on this machine, or one that runs.

    Attributes:
        about: what it runs on, a line for the user.
    """

    def __init__(self, work: Work, address: str | None) -> None:
        try:
            import ray  # noqa: PLC0415 - few need it
        except ImportError as error:
            raise OptionError(f"engine ray needs the package ray: pip install '{EXTRA}'") from error
        self._ray: Any = ray
        how: dict[str, Any] = {"address": address}
        if address is not None:
            _check_answers(address)
        else:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            how = {"num_cpus": threads_or_cpus(None), "address": "local"}
        # Functions and options of this package are sent by name: nodes have it installed.
        try:
            with handlers_kept():  # Ray has one of its own for the end of a process
                context = ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise OptionError(f"no Ray at {address or 'this machine'}: {line}") from error
        dashboard = context.dashboard_url
        self._seen = -_LOOK
        self._look()
        self.about = f"Ray of {self._cores:.0f} cores" + (
            f", dashboard http://{dashboard}" if dashboard else ""
        )
        # Attempts are counted by the driver, for faults of all kinds.
        self._attempt = ray.remote(max_retries=0)(attempt_here)
        self._work = ray.put(work)
        self._running: dict[Any, Job] = {}

    def has_room(self, job: Job) -> bool:
        """Whether Ray has too little to do; where to run a video it decides by itself."""
        del job
        self._look()
        return len(self._running) < max(_LEAST_AHEAD, _AHEAD * self._cores)

    def submit(self, job: Job) -> None:
        """Attempt a video as soon as a node has what it needs, or all of the largest node."""
        cores = min(job.needs.cores, self._largest["CPU"])
        memory = min(job.needs.memory, self._largest["memory"])
        task = self._attempt.options(num_cpus=cores, memory=memory, name=f"video {job.position}")
        self._running[task.remote(self._work, job)] = job

    def wait(self, seconds: float) -> Sequence[tuple[Job, Outcome]]:
        """The attempts that have ended since, at least one unless none does in that time."""
        running = list(self._running)
        if not running:
            return []
        ended, _ = self._ray.wait(running, num_returns=1, timeout=seconds)
        if ended:  # and others, perhaps
            ended, _ = self._ray.wait(running, num_returns=len(running), timeout=0)
        outcomes = [(self._running[task], self._outcome(task)) for task in ended]
        for task in ended:
            del self._running[task]
        return outcomes

    def close(self) -> None:
        """Stop all attempts at once."""
        for task in self._running:
            self._ray.cancel(task, force=True)
        self._ray.shutdown()

    def _outcome(self, task: Any) -> Outcome:
        """What an attempt came to, or how Ray lost it."""
        job = self._running[task]
        failures = self._ray.exceptions
        try:
            outcome: Outcome = self._ray.get(task)
            return outcome
        except failures.OutOfMemoryError:
            reason, text = "memory", "stopped by Ray, as its node ran out of memory"
        except failures.RayTaskError as error:
            line = str(error.cause).splitlines()[0] if str(error.cause) else ""
            reason, text = "defect", f"{type(error.cause).__name__}: {line}"
        except failures.RayError as error:
            reason, text = "lost", f"its machine or process was lost ({type(error).__name__})"
        row = Row(job.name, without_secrets(str(job.source)), "failed", reason, error=text)
        return Ended(row, passing=reason != "defect", starved=reason == "memory")

    def _look(self) -> None:
        """See how large the cluster is now."""
        if time.monotonic() - self._seen < _LOOK:
            return
        nodes = [
            n["Resources"] for n in self._ray.nodes() if n["Alive"] and "CPU" in n["Resources"]
        ]
        if not nodes:
            raise OptionError("Ray has no node with a CPU: start one, or leave out --address")
        self._seen = time.monotonic()
        self._cores: float = sum(node["CPU"] for node in nodes)
        self._largest = {what: max(n.get(what, 0) for n in nodes) for what in ("CPU", "memory")}


def _check_answers(address: str) -> None:
    """Refuse an address where nothing answers, to which Ray would try to connect for long.

    Raises:
        OptionError: nothing answers.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal():  # such as 'auto'
        return
    try:
        socket.create_connection((host, int(port)), _ANSWERS).close()
    except (OSError, OverflowError) as error:
        raise OptionError(
            f"no Ray at {address}: {error}: give the address that 'ray start' has printed"
        ) from error


def attempt_here(work: Work, job: Job) -> Outcome:
    """Attempt a video on the node where this runs, in a process beside Ray's.

    What ends that process, its time or memory, is then known, and Ray's own goes on.
    """
    global _worker  # noqa: PLW0603 - as long as Ray uses this process for further videos
    if _worker is None:
        _worker = Worker(work.scratch)
    return _worker.run(work, job)
