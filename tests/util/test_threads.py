"""A function applied to items on several threads."""

import contextlib
import threading
import time
from collections.abc import Iterator

import pytest

from colmap_av1.util.threads import map_on_threads


@pytest.mark.parametrize("num_threads", [1, 3])
def test_results_have_the_order_of_the_items(num_threads: int) -> None:
    def slow_first(number: int) -> int:
        time.sleep(0.002 * (20 - number))
        return number * number

    found = list(map_on_threads(slow_first, range(20), num_threads))
    assert found == [number * number for number in range(20)]


def test_calls_run_at_the_same_time() -> None:
    both = threading.Barrier(2, timeout=20)
    assert len(list(map_on_threads(lambda _: both.wait(), range(2), 2))) == 2


def test_few_items_are_taken_ahead_of_the_results() -> None:
    taken = 0

    def items() -> Iterator[int]:
        nonlocal taken
        for number in range(1000):
            taken += 1
            yield number

    with contextlib.closing(map_on_threads(lambda number: number, items(), 2)) as found:
        assert next(found) == 0
        assert taken < 20
    assert taken < 20


def test_an_error_of_a_call_ends_the_iteration() -> None:
    def fail_at_three(number: int) -> int:
        if number == 3:
            raise ValueError("three")
        return number

    found = map_on_threads(fail_at_three, range(100), 2)
    assert [next(found) for _ in range(3)] == [0, 1, 2]
    with pytest.raises(ValueError, match="three"):
        next(found)


def test_an_error_of_the_items_ends_the_iteration() -> None:
    def items() -> Iterator[int]:
        yield 0
        raise OSError("unreadable")

    with pytest.raises(OSError, match="unreadable"):
        list(map_on_threads(lambda number: number, items(), 2))
