"""The compiled engine: the forward passes and their backward compiled by torch.compile.

It never falls back midway: code that cannot be compiled as a whole raises.
"""

from __future__ import annotations

import torch
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, LearningConfig
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.passes import DifferentiatedPass, Encoded, forward_passes
from switchmt_snn.updates.protocol import Engine, Values

COMPILE_FROM_UPDATES = 150_000
"""``auto`` compiles runs of at least this many updates: half a minute at the start saves minutes to hours."""


class Compiled(Engine):
    """Compiled by torch.compile, on any device."""

    name = "compiled"
    needs = "a C++ compiler that torch.compile can use (Debian: apt install g++ python3-dev)"
    note = "updates are compiled: the first ones take some 20 to 35 s (learning.engine=eager does without)"

    def __init__(self, network: QNetwork, target: QNetwork, config: LearningConfig) -> None:
        super().__init__(network, target, config)
        differentiated = DifferentiatedPass(network, self.precision)
        self._passes = forward_passes(network, target, differentiated, self.precision, config, compile_whole)

    @classmethod
    def unavailable(cls, config: ExperimentConfig, device: torch.device, processes: int = 1) -> str | None:
        """See ``Engine.unavailable``; compiles something small."""
        reason = super().unavailable(config, device, processes)
        if reason is None and (problem := compile_problem()) is not None:
            reason = f"torch.compile fails on this machine ({problem})"
        return reason

    @classmethod
    def pays(cls, config: ExperimentConfig, device: torch.device, precision: str) -> bool:
        """For a run on a CPU that is long enough for its compilation."""
        return device.type == "cpu" and planned_updates(config) >= COMPILE_FROM_UPDATES

    @classmethod
    def status(cls) -> str:
        """See ``Engine.status``; compiles something small."""
        return compile_problem() or "works"

    def values(self, observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        """See ``Engine.values``."""
        return self._passes(observations, next_observations, task, generator)


def compile_whole(function: Encoded) -> Encoded:
    """The function as one compiled graph for tensors of fixed shapes."""
    from torch import _dynamo as dynamo  # takes a second to import

    # One code object is compiled anew for every learner of the process.
    dynamo.config.recompile_limit = max(dynamo.config.recompile_limit, 256)
    result: Encoded = torch.compile(function, fullgraph=True, dynamic=False)
    return result


def planned_updates(config: ExperimentConfig) -> int:
    """Updates that a run of a resolved config makes, warm-ups not subtracted."""
    learning = config.learning
    each = len(config.tasks.names) if learning.update_tasks == "all" else 1
    return config.total_steps // learning.update_every_steps * learning.updates_per_round * each


def compile_problem() -> str | None:
    """The first line of what goes wrong when something small is compiled; None if nothing does."""
    try:
        torch.compile(lambda x: x.sin() + 1.0)(torch.ones(8))
    except Exception as error:
        return str(error).strip().splitlines()[0][:120] if str(error).strip() else type(error).__name__
    return None
