"""How many threads a process may run at a time."""

from __future__ import annotations

import os


def threads_or_cpus(num_threads: int | None) -> int:
    """The number of threads; None: one per CPU that this process may use."""
    if num_threads is not None:
        return num_threads
    if hasattr(os, "sched_getaffinity"):  # fewer than the machine has in containers and queues
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cpu_seconds() -> float:
    """CPU time in seconds of this process and of those it waited for."""
    spent = os.times()
    return spent.user + spent.system + spent.children_user + spent.children_system
