"""Engines that process the videos of a batch: local processes, or tasks of Ray."""

from __future__ import annotations

import logging
import os
import socket
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

from colmap_av1.batch.command import Processes
from colmap_av1.batch.inputs import Video
from colmap_av1.batch.video import Outcome, Work, process_video
from colmap_av1.errors import OptionError
from colmap_av1.options import BatchOptions
from colmap_av1.util.cpus import threads_or_cpus
from colmap_av1.util.failures import Failure, failure_of
from colmap_av1.util.memory import usable_memory
from colmap_av1.util.signals import handlers_kept

EXTRA = "colmap-av1[cluster]"
_MEMORY_OF_VIDEO = 4 << 30
_ANSWERS = 10.0  # Seconds to wait for a connection to the address of Ray.


class LocalEngine:
    """Processes each video in a separate process on this machine.

    Attributes:
        about: one line for the user about the resources in use.
    """

    def __init__(self, work: Work, options: BatchOptions, num_videos: int) -> None:
        cores = threads_or_cpus(None)
        if options.cores is not None:
            most = cores // options.cores
        else:
            most = min(cores, usable_memory() // _MEMORY_OF_VIDEO)
        num_jobs = max(1, min(most, num_videos))
        self._work, self._threads = work, options.cores or max(1, cores // num_jobs)
        self._processes = Processes()
        # These threads only wait for the processes.
        self._pool = ThreadPoolExecutor(num_jobs)
        self.about = f"{num_jobs} videos at a time, {self._threads} threads each"

    def submit(self, video: Video) -> Future[Outcome]:
        """Process a video as soon as a thread is free."""
        return self._pool.submit(process_video, self._work, video, self._threads, self._processes)

    def failure(self, error: BaseException) -> Failure:
        """The reason why a future has no outcome."""
        return failure_of(error)

    def close(self) -> None:
        """Stop all processes."""
        self._pool.shutdown(wait=False, cancel_futures=True)
        self._processes.stop()
        self._pool.shutdown(wait=True)


class RayEngine:
    """Processes each video in a task of Ray, started on this machine or already running.

    Attributes:
        about: one line for the user about the resources in use.
    """

    def __init__(self, work: Work, options: BatchOptions) -> None:
        try:
            import ray  # noqa: PLC0415 - an optional dependency
        except ImportError as error:
            raise OptionError(f"engine ray needs the package ray: pip install '{EXTRA}'") from error
        self._ray: Any = ray
        address = options.address
        how: dict[str, Any] = {"address": address}
        if address is not None:
            _check_answers(address)
        else:
            os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
            how = {"num_cpus": threads_or_cpus(None), "address": "local"}
        try:
            with handlers_kept():  # Ray installs a SIGTERM handler of its own.
                context = ray.init(**how, log_to_driver=False, logging_level=logging.ERROR)
        except (ConnectionError, ValueError, RuntimeError) as error:
            line = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise OptionError(f"no Ray at {address or 'this machine'}: {line}") from error
        nodes = [n["Resources"].get("CPU", 0) for n in ray.nodes() if n["Alive"]]
        if not any(nodes):
            ray.shutdown()
            raise OptionError("Ray has no node with a CPU: start one, or omit --address")
        self._threads = int(min(options.cores or 1, max(nodes)))
        dashboard = f", dashboard http://{context.dashboard_url}" if context.dashboard_url else ""
        self.about = f"Ray of {sum(nodes):.0f} cores{dashboard}"
        # Ray retries a task whose node or process was lost.
        self._task = ray.remote(max_retries=options.retries)(_process_on_node)
        self._work = ray.put(work)
        self._running: set[Any] = set()

    def submit(self, video: Video) -> Future[Outcome]:
        """Process a video as soon as a node has enough free cores."""
        task = self._task.options(num_cpus=self._threads, name=f"video {video.name}")
        reference = task.remote(self._work, video, self._threads)
        self._running.add(reference)
        future: Future[Outcome] = reference.future()
        future.add_done_callback(lambda _: self._running.discard(reference))
        return future

    def failure(self, error: BaseException) -> Failure:
        """The reason why Ray could not process a video."""
        failures = self._ray.exceptions
        if isinstance(error, failures.OutOfMemoryError):
            return Failure("memory", "stopped by Ray, as its node ran out of memory")
        if isinstance(error, failures.RayTaskError):
            return failure_of(error.cause)
        name = type(error).__name__
        return Failure("lost", f"its machine or process was lost ({name})")

    def close(self) -> None:
        """Stop all tasks."""
        for task in list(self._running):
            self._ray.cancel(task, force=True)
        self._ray.shutdown()


def _check_answers(address: str) -> None:
    """Refuse an address that does not accept connections: Ray itself would retry for minutes.

    Raises:
        OptionError: the connection fails.
    """
    host, colon, port = address.removeprefix("ray://").rpartition(":")
    if not colon or not port.isdecimal():  # For example 'auto'.
        return
    try:
        socket.create_connection((host, int(port)), _ANSWERS).close()
    except (OSError, OverflowError) as error:
        raise OptionError(
            f"no Ray at {address}: {error}: give the address that 'ray start' printed"
        ) from error


def _process_on_node(work: Work, video: Video, threads: int) -> Outcome:
    return process_video(work, video, threads, Processes())
