"""Work that is begun before its result is asked for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

T = TypeVar("T")


def in_order(tasks: Iterable[Callable[[], T]], threads: int) -> Generator[T, None, None]:
    """What the tasks return, in their order; `threads` of them run at a time.

    Each result is asked for while the next tasks run: at most `threads` more are begun. 1: no threads; each task runs
    when its result is asked for. What a task raises is raised in its place; tasks that have not begun are then dropped.
    """
    if threads < 2:
        for task in tasks:
            yield task()
        return
    begun: deque[Future[T]] = deque()
    with ThreadPoolExecutor(threads, thread_name_prefix="understudy-ahead") as pool:
        try:
            for task in tasks:
                begun.append(pool.submit(task))
                if len(begun) > threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for future in begun:
                future.cancel()
