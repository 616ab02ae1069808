"""All cores, for work in independent parts."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError, ThreadPoolExecutor
from contextlib import contextmanager
from typing import TypeVar

import torch
from threadpoolctl import threadpool_limits

P = TypeVar("P")
R = TypeVar("R")


@contextmanager
def all_cores() -> Iterator[ThreadPoolExecutor]:
    """A pool with one thread per core. Until it ends, PyTorch and NumPy's BLAS use one thread each.

    After an exception (Ctrl-C, too) parts that have not begun never do.
    """
    with _one_thread_each(), ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
        try:
            yield pool
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class Parts:
    """Parts of a long work, in several threads or one after the other in this one."""

    def __init__(self, pool: ThreadPoolExecutor | None) -> None:
        self._pool = pool
        self.stopped = threading.Event()

    def map(self, function: Callable[[P], R], parts: Iterable[P]) -> Iterator[R]:
        """Results in order; without a pool each part is worked on when it is asked for."""
        return map(function, parts) if self._pool is None else self._pool.map(function, parts)

    def check(self) -> None:
        """Called by a part at every step: raises once the whole work has been interrupted.

        Raises:
            CancelledError: another part failed, or the caller was interrupted.
        """
        if self.stopped.is_set():
            raise CancelledError


@contextmanager
def parts(in_threads: bool) -> Iterator[Parts]:
    """Work in parts, with one thread per core or in this thread; numbers are the same.

    After an exception (Ctrl-C, too) parts that are running stop at their next ``check``.
    """
    if not in_threads:
        with _one_thread_each():
            yield Parts(None)
        return
    with all_cores() as pool:
        work = Parts(pool)
        try:
            yield work
        except BaseException:
            work.stopped.set()
            raise


@contextmanager
def _one_thread_each() -> Iterator[None]:
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"):
            yield
    finally:
        torch.set_num_threads(threads)
