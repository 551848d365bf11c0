"""Work shared by two threads."""

from __future__ import annotations

import time
from collections.abc import Iterator
from threading import Barrier

import pytest

from tracker.threads import THREADS, side_by_side


def test_results_come_in_order_however_long_each_takes() -> None:
    def late(item: int) -> int:
        time.sleep(0.02 * (item % 2 == 0))
        return 10 * item

    assert list(side_by_side(late, range(7))) == [10 * item for item in range(7)]
    assert list(side_by_side(late, [])) == []


def test_as_many_as_there_are_threads_work_at_once() -> None:
    together = Barrier(THREADS, timeout=5)  # breaks unless all come at the same time
    assert list(side_by_side(lambda item: together.wait() >= 0, range(2 * THREADS))) == [True] * 2 * THREADS


def test_items_are_taken_as_there_are_threads_for_them() -> None:
    taken: list[int] = []

    def items() -> Iterator[int]:
        for item in range(20):
            taken.append(item)
            yield item

    results = side_by_side(lambda item: item, items())
    for item in range(20):
        assert next(results) == item
        assert len(taken) <= item + THREADS + 1, "a long clip's cut-outs are not all held"


def test_a_mistake_within_a_thread_is_raised() -> None:
    with pytest.raises(ZeroDivisionError):
        list(side_by_side(lambda item: 1 / item, [1, 0, 1]))
