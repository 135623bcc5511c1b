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
