"""The native engine: the forward passes, their backward and Adam in C++, for spiking networks on a CPU.

The only file outside of ``native/`` that imports it, and only when a run takes the engine: without that folder,
everything else works, and the engine says why it does not.
"""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from switchmt_snn.config import METHOD_TRAITS, ExperimentConfig, LearningConfig
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.updates.compiled import planned_updates
from switchmt_snn.updates.protocol import Engine, Values

BUILD_FROM_UPDATES = 5_000
"""Updates of a small network that are worth building the C++ code (some 7 s, once per machine)."""


class Native(Engine):
    """In C++, which is built once per machine."""

    name = "native"
    needs = "a spiking network on a CPU and a C++ compiler (g++, or what CXX names)"
    note = "updates run natively, in C++ (learning.engine=eager does without)"
    acts = True

    def __init__(self, network: QNetwork, target: QNetwork, config: LearningConfig) -> None:
        """Raises ConfigError for a network that the C++ code does not support, naming the setting or module."""
        super().__init__(network, target, config)
        from switchmt_snn.native.network import NativeNetwork

        self._online, self._target = NativeNetwork(network, self.precision), NativeNetwork(target, self.precision)
        acts, its_own = (target, self._target) if config.acting_network == "target" else (network, self._online)
        # In float32, as evaluations and exports play it: rounded to bfloat16, a spiking network chooses another action
        # in a fifth to a half of the states (results/atari).
        self._acting = its_own if self.precision is None else NativeNetwork(acts, None)

    @classmethod
    def unavailable(cls, config: ExperimentConfig, device: torch.device, processes: int = 1) -> str | None:
        """See ``Engine.unavailable``; builds the C++ sources if they are not built yet."""
        if (reason := super().unavailable(config, device, processes)) is not None:
            return reason
        if device.type != "cpu":
            return f"this run is on device {device.type}"
        supports = _supports()
        if supports is None:
            return _MISSING
        if (setting := supports.unsupported_setting(config.network)) is not None:
            return f"it has no code for {setting}"
        problem = supports.problem()
        return None if problem is None else f"it cannot be built here ({problem})"

    @classmethod
    def pays(cls, config: ExperimentConfig, device: torch.device, precision: str) -> bool:
        """On the nature trunk it is the fastest engine (docs/performance.md) if its products of spikes are sums over
        bits, or the other products are bfloat16. On the mlp trunk it takes about half of eager's time, also with AVX2
        alone, which pays for building it in runs of some thousand updates. MinAtar's small network is faster compiled.
        """
        spiking = METHOD_TRAITS[config.network.method].spiking
        trunk, is_short = config.network.trunk, planned_updates(config) < BUILD_FROM_UPDATES
        if device.type != "cpu" or not spiking or trunk == "minatar" or (trunk == "mlp" and is_short):
            return False
        supports = _supports()
        if trunk == "mlp" or precision == "bfloat16" or supports is None or supports.problem() is not None:
            return True  # if it cannot be built, unavailable() says why
        return bool(supports.spikes_as_bits(torch.float32))

    @classmethod
    def status(cls) -> str:
        """See ``Engine.status``; builds the C++ sources if they are not built yet."""
        supports = _supports()
        if supports is None:
            return _MISSING
        problem: str | None = supports.problem()
        if problem is not None:
            return problem
        has_bits = supports.spikes_as_bits(torch.float32)
        return "works" if has_bits else "works, without sums over bits (no AVX-512)"

    def values(self, observations: Tensor, next_observations: Tensor, task: int, generator: torch.Generator) -> Values:
        """See ``Engine.values``. The choice of the next action shares products with the differentiated pass."""
        online, target, double_q = self._online, self._target, self.config.double_q
        by = self.config.next_statistics
        x_next = target.inputs(next_observations, generator)
        with torch.no_grad():
            (next_values,) = target.decide(x_next, target.for_task(task), training=False, statistics=by)
        if double_q and self.network.encoder.is_random:
            x_next = online.inputs(next_observations, generator)
        x, others = online.inputs(observations, generator), [x_next] if double_q else []
        values, *choice = online.decide(x, online.for_task(task), training=True, other_inputs=others, statistics=by)
        return Values(values, next_values, *(choice or [self.target.expected(next_values)]))

    def decisions(self, observations: Tensor, task: int, generator: torch.Generator) -> Tensor:
        """See ``Engine.decisions``."""
        network = self._acting
        return network.act(network.inputs(observations, generator), network.for_task(task))

    def optimizer(self) -> torch.optim.Optimizer:
        """Adam in C++, which also writes the weights' rounded copies."""
        from switchmt_snn.native.adam import NativeAdam

        return NativeAdam(self.network.parameters(), self.config.learning_rate, self.config.adam_epsilon, self._online)


_MISSING = "the package switchmt_snn.native is not installed"


def _supports() -> ModuleType | None:
    """The module that says what the C++ code supports; None if the package lacks it."""
    try:
        from switchmt_snn.native import supports
    except ModuleNotFoundError as error:
        if error.name is None or not error.name.startswith("switchmt_snn.native"):
            raise
        return None
    return supports
