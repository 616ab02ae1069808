"""Calling code from outside the package so that nothing in the process changes but its result."""

from __future__ import annotations

import random
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import torch


@contextmanager
def apart(seed: int = 0) -> Iterator[None]:
    """On the CPU, with gradients, and with random numbers of its own: the process's generators stay where they are.

    Args:
        seed: of the global generators (``random``, ``numpy.random``, ``torch``) inside.
    """
    python, numpy = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng(devices=[]), torch.device("cpu"), torch.enable_grad():
            torch.default_generator.manual_seed(seed)
            random.seed(seed)
            np.random.seed(seed)
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy)
