"""All cores for work that falls into independent parts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


@contextmanager
def all_cores() -> Iterator[ThreadPoolExecutor]:
    """A thread for every core; PyTorch and NumPy's BLAS on one thread each meanwhile."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)
