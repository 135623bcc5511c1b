"""Apply a function to items on several threads."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

from colmap_av1.util.cpus import threads_or_cpus

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")

# Number of items per thread that are taken ahead of the results. It bounds the memory of pictures.
_AHEAD = 2


def map_on_threads(
    function: Callable[[_Item], _Result], items: Iterable[_Item], num_threads: int | None = None
) -> Generator[_Result, None, None]:
    """Yield `function(item)` for each item, in the order of the items.

    The calls run in parallel where they release the interpreter lock, as most functions of NumPy,
    OpenCV and this package's core do.

    Args:
        function: called on one of the threads.
        items: taken on the thread of the caller, a few items ahead.
        num_threads: number of threads; None: one per CPU that the process may use.
    """
    num_threads = threads_or_cpus(num_threads)
    queue: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(max_workers=num_threads) as executor:
        try:
            for item in items:
                queue.append(executor.submit(function, item))
                if len(queue) > num_threads * _AHEAD:
                    yield queue.popleft().result()
            while queue:
                yield queue.popleft().result()
        finally:
            executor.shutdown(wait=True, cancel_futures=True)
