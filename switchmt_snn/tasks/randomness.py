"""The global random generators, for environments that draw from them: an episode is a function of its seed."""

from __future__ import annotations

import random
import threading
from types import TracebackType

import numpy as np
import torch
from numpy.random import mtrand

_ONE_AT_A_TIME = threading.RLock()


class OwnGenerators:
    """The global generators of ``random``, ``numpy.random`` and torch (CPU), as one environment finds them.

    A context manager. Within it they are as this environment left them (after ``seed``, freshly seeded), whatever drew
    from them meanwhile; outside they are as everybody else left them. Two threads are never within at the same time.
    """

    def __init__(self) -> None:
        self._others_python = random.getstate()
        self._others_numpy = mtrand.get_bit_generator()
        self._others_torch = torch.default_generator.get_state()
        self.seed(0)

    def seed(self, seed: int) -> None:
        """Seed them, for the next entry."""
        self._seed = seed
        self._python = random.Random(seed).getstate()
        self._numpy: np.random.BitGenerator = np.random.MT19937(seed)
        self._torch = torch.Generator().manual_seed(seed).get_state()

    @property
    def were_used(self) -> bool:
        """Whether the environment drew from one of them, or seeded it, since ``seed``."""
        fresh = OwnGenerators()
        fresh.seed(self._seed)
        return (
            fresh._python != self._python
            or str(fresh._numpy.state) != str(self._numpy.state)
            or not torch.equal(fresh._torch, self._torch)
        )

    def __enter__(self) -> None:
        _ONE_AT_A_TIME.acquire()
        self._others_python, self._others_numpy = random.getstate(), mtrand.get_bit_generator()
        self._others_torch = torch.default_generator.get_state()
        random.setstate(self._python)
        mtrand.set_bit_generator(self._numpy)
        torch.default_generator.set_state(self._torch)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._python, self._numpy = random.getstate(), mtrand.get_bit_generator()
        self._torch = torch.default_generator.get_state()
        random.setstate(self._others_python)
        mtrand.set_bit_generator(self._others_numpy)
        torch.default_generator.set_state(self._others_torch)
        _ONE_AT_A_TIME.release()
