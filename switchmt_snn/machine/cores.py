"""All cores, for work in independent parts."""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager

import torch
from threadpoolctl import threadpool_limits


@contextmanager
def all_cores() -> Iterator[ThreadPoolExecutor]:
    """A pool with one thread per core. Until it ends, PyTorch and NumPy's BLAS use one thread each."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with threadpool_limits(1, user_api="blas"), ThreadPoolExecutor(max_workers=os.cpu_count()) as pool:
            yield pool
    finally:
        torch.set_num_threads(threads)
