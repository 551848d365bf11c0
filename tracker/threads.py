"""Work shared by two threads, for functions that let go of the interpreter for most of their time."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

THREADS = 2

Item = TypeVar("Item")
Result = TypeVar("Result")


def side_by_side(function: Callable[[Item], Result], items: Iterable[Item]) -> Iterator[Result]:
    """What the function gives for each item, in their order; items are taken as there are threads for them."""
    waiting = deque[Future[Result]]()
    with ThreadPoolExecutor(THREADS) as threads:
        for item in items:
            if len(waiting) == THREADS:
                yield waiting.popleft().result()
            waiting.append(threads.submit(function, item))
        for future in waiting:
            yield future.result()
