"""A learner whose updates several processes divide (see ``switchmt_snn.updates.processes``)."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch

from switchmt_snn.config import LearningConfig
from switchmt_snn.learning.learner import Learner
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.processes import COPY_TARGET, LOAD, SCALE, STOP, UPDATE, Divided, ProcessGroup


class SharedLearner(Learner):
    """Every process has one. The first process uses it as any learner; the others call ``serve``.

    Whatever changes the learner is announced by the first process and done in all of them.
    """

    DERIVED = (*Learner.DERIVED, "_group")

    def __init__(
        self,
        network: QNetwork,
        config: LearningConfig,
        valid_actions_KA: npt.NDArray[np.bool_],
        device: torch.device,
        seed: int,
        group: ProcessGroup,
    ) -> None:
        """As ``Learner``; the networks of all processes are equal.

        Args:
            network: fresh or trained; moved to ``device``.
            config: resolved settings.
            valid_actions_KA: which actions exist in which task.
            device: where this process learns.
            seed: of the encoding's random numbers; each process has its own.
            group: the processes that divide every update.
        """
        self._group = group
        super().__init__(network, config, valid_actions_KA, device, seed, partial(Divided, group=group))

    def update(self, batch: Batch, task: int) -> None:
        """First process: one gradient step on a batch, divided among all processes."""
        self._group.announce(UPDATE, task)
        super().update(self._group.deal(batch), task)

    def copy_target(self) -> None:
        """First process: Q* <- Q in all processes."""
        self._group.announce(COPY_TARGET)
        super().copy_target()

    def set_scale(self, task: int, scale: float) -> None:
        """First process: as ``Learner.set_scale`` in all processes."""
        super().set_scale(task, scale)
        self._group.announce(SCALE, task)
        self._group.share(scale)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """First process: put a saved state back in all processes."""
        super().load_state_dict(state)
        self._group.announce(LOAD)
        self._group.share(state)

    def serve(self, like: Batch) -> None:
        """Other processes: do what the first one announces, until it stops.

        Args:
            like: a batch of the shapes and dtypes that are dealt to this process.
        """
        while (message := self._group.heard())[0] != STOP:
            what, task = message
            if what == UPDATE:
                super().update(self._group.dealt(like), task)
            elif what == COPY_TARGET:
                super().copy_target()
            elif what == LOAD:
                super().load_state_dict(self._group.share())
            elif what == SCALE:
                super().set_scale(task, self._group.share())
            else:
                raise ValueError(f"announcement {what}, expected one of {(STOP, UPDATE, COPY_TARGET, LOAD, SCALE)}")
        super().close()

    def close(self) -> None:
        """First process: let the other processes go; no update can follow."""
        self._group.announce(STOP)
        super().close()
