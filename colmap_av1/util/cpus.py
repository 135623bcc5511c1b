"""How many threads a process may run at a time."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

# As OpenBLAS reads it when it is loaded.
BLAS_THREADS = "OPENBLAS_NUM_THREADS"


def threads_or_cpus(num_threads: int | None) -> int:
    """The number of threads; None: one per CPU that this process may use."""
    if num_threads is not None:
        return num_threads
    if hasattr(os, "sched_getaffinity"):  # fewer than the machine has in containers and queues
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


@contextmanager
def one_blas_thread() -> Iterator[None]:
    """Let matrix products of the body, or of a function that this decorates, take one thread.

    Others wait for more work in a loop, a tenth of a second each time: several times as long as
    products of the sizes here take.
    """
    with threadpool_limits(1, user_api="blas"):
        yield


def cpu_seconds() -> float:
    """CPU time in seconds of this process and of those it waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system
