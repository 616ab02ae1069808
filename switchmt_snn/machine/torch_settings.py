"""PyTorch's settings of a process, which a notebook may have changed: a run's numbers do not depend on them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import torch


@contextmanager
def as_when_started() -> Iterator[None]:
    """PyTorch as in a new process; afterwards it is as the caller had it.

    Default dtype and device, autocast, inference mode, gradients, the precision of float32 products, cuDNN's choice of
    algorithms, and the number of threads. Dtype, precision and threads are of the whole process: of two threads that
    enter together with others than PyTorch's own, the first that leaves gives the caller's back.
    """
    dtype, precision = torch.get_default_dtype(), torch.get_float32_matmul_precision()
    threads, deterministic = torch.get_num_threads(), torch.backends.cudnn.deterministic
    with ExitStack() as modes:
        if torch.get_default_device().type != "cpu":  # entered only then: this mode slows every operation
            modes.enter_context(torch.device("cpu"))
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                modes.enter_context(torch.autocast(device, enabled=False))
        modes.enter_context(torch.inference_mode(False))
        modes.enter_context(torch.enable_grad())
        if dtype != torch.float32:
            torch.set_default_dtype(torch.float32)
        if precision != "highest":
            torch.set_float32_matmul_precision("highest")
        try:
            yield
        finally:
            if dtype != torch.float32:
                torch.set_default_dtype(dtype)
            if precision != "highest":
                torch.set_float32_matmul_precision(precision)
            if torch.get_num_threads() != threads:
                torch.set_num_threads(threads)
            torch.backends.cudnn.deterministic = deterministic
