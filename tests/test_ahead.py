"""Work that is begun before its result is asked for."""

import threading
import time
from collections.abc import Iterator
from functools import partial

import pytest

from understudy.ahead import in_order


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_results_come_in_order(threads):
    def slow(i: int) -> int:
        time.sleep(0.01 if i % 3 == 0 else 0)
        return i

    assert list(in_order((partial(slow, i) for i in range(20)), threads)) == list(range(20))
    assert list(in_order([], threads)) == []


def test_so_many_at_a_time_and_few_ahead():
    together, taken = threading.Barrier(3, timeout=20), 0

    def tasks() -> Iterator[partial[int]]:
        nonlocal taken
        for _ in range(9):
            taken += 1
            yield partial(together.wait)  # returns only when three run at a time

    results = in_order(tasks(), 3)
    next(results)
    assert taken == 4, "no more than are worked on while the first result is used"
    assert len(list(results)) == 8


def test_one_thread_is_this_one():
    names = list(in_order([lambda: threading.current_thread().name] * 3, 1))
    assert set(names) == {threading.current_thread().name}


@pytest.mark.parametrize("threads", [1, 2])
def test_an_error_comes_in_its_place_and_ends_it(threads):
    begun: list[int] = []

    def work(i: int) -> int:
        begun.append(i)
        if i == 2:
            raise ValueError("two")
        return i

    results = in_order((partial(work, i) for i in range(50)), threads)
    assert [next(results), next(results)] == [0, 1]
    with pytest.raises(ValueError, match="two"):
        next(results)
    assert len(begun) <= 5, "the others are dropped"
    assert list(results) == []
