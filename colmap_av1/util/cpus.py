"""Number of threads that a process may use, and CPU time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

# OpenBLAS reads this environment variable when it is loaded.
BLAS_THREADS = "OPENBLAS_NUM_THREADS"


def threads_or_cpus(num_threads: int | None) -> int:
    """The number of threads; None: one per CPU that this process may use."""
    if num_threads is not None:
        return num_threads
    if hasattr(os, "sched_getaffinity"):  # containers and job queues may allow fewer CPUs
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let matrix products use one thread in the body, or in the function that this decorates.

    Further threads of BLAS wait for more work in a loop, for a tenth of a second each time. That is
    several times as long as a product of the small matrices here.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


def cpu_seconds() -> float:
    """CPU time in seconds of this process and of the child processes that it waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system
