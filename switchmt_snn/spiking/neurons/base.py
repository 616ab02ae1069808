"""What a neuron model gives, and the loop over T simulation steps.

A model is one subclass of ``NeuronLayer`` in one file. Its ``step`` is the equation, written
once; every other form (fused, snnTorch's, C++, ONNX) is tested against it.

Shapes: T simulation steps, B batch, ... any feature shape, O output channels or features.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import snntorch
import torch
from torch import Tensor, nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.config.plugins import plugin_name
from switchmt_snn.spiking.layers import NeuronNode
from switchmt_snn.spiking.neurons.surrogates import make_surrogate
from switchmt_snn.spiking.settings import require_known

NeuronState = tuple[Tensor, ...]
"""State variables ``[B, ...]`` of a layer, in the order of ``NeuronLayer.STATE``."""

Step = Callable[[Tensor, NeuronState], tuple[Tensor, NeuronState]]
"""``(current_t, state) -> (spikes_t, state)``: one simulation step."""

RESETS = ("zero", "subtract")
"""What a spike does to the membrane: set it to zero, or subtract the threshold."""

_Module = TypeVar("_Module", bound=nn.Module)


@dataclass(frozen=True)
class OpaqueNode(NeuronNode):
    """Neurons of a model that only its own class knows. Every exporter refuses it by name.

    Attributes:
        name: the model, as a config names it.
        variables: names of its state variables.
    """

    name: str
    variables: tuple[str, ...]

    @property
    def kind(self) -> str:
        """The model's name."""
        return self.name

    @property
    def states(self) -> tuple[str, ...]:
        """``variables``."""
        return self.variables


class NeuronLayer(nn.Module):
    """A layer of neurons: input currents over T steps -> spikes over T steps. The state is passed in and returned.

    A subclass defines ``STATE`` and ``step``. It may define ``node``, so that exporters can know it, and ``run``, for a
    faster form of the same loop. A class that changes an inherited step does not inherit these two.

    Attributes:
        STATE: names of the state variables.
        ENGINES: the values of ``network.neuron_engine`` that the model has.
        surrogate: ``U - theta -> S``, the Heaviside step with the surrogate gradient that the config names.
    """

    STATE: ClassVar[tuple[str, ...]] = ()
    ENGINES: ClassVar[tuple[str, ...]] = ("fused",)

    def __init_subclass__(cls, **kwargs: Any) -> None:
        """A class with a step of its own inherits no faster form, engine or description of another class's step."""
        super().__init_subclass__(**kwargs)
        if "step" in cls.__dict__:
            for name in ("run", "node", "ENGINES"):
                if name not in cls.__dict__:
                    setattr(cls, name, NeuronLayer.__dict__[name])

    def __init__(self, config: NetworkConfig) -> None:
        """Check the settings that all models share.

        Raises:
            ConfigError: ``config.neuron_engine`` or ``config.reset`` is a value that the model does not have.
        """
        super().__init__()
        require_known("neuron_engine", config.neuron_engine, self.ENGINES, f"network.neuron is {config.neuron}")
        require_known("reset", config.reset, RESETS)
        self.surrogate = make_surrogate(config.surrogate, config.surrogate_slope)

    def initial_state(self, current_t: Tensor) -> NeuronState:
        """The state at rest, zeros, for currents ``[B, ...]`` of one step."""
        return tuple(torch.zeros_like(current_t) for _ in self.STATE)

    def step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """One simulation step: the model's equation. It changes neither its arguments nor the module.

        Args:
            current_t: input currents ``[B, ...]``.
            state: state variables ``[B, ...]``.

        Returns:
            spikes ``[B, ...]`` in {0, 1}, and the new state.
        """
        raise NotImplementedError(f"{type(self).__name__} defines no step, expected its equation")

    def node(self, channels: int) -> NeuronNode:
        """The layer's description for exporters and counters; ``channels`` is O."""
        return OpaqueNode(plugin_name(type(self), "network.neuron"), self.STATE)

    def forward(self, current: Tensor, state: NeuronState | None = None) -> tuple[Tensor, NeuronState]:
        """Run T steps.

        Args:
            current: ``[T, B, ...]`` float input currents.
            state: what an earlier call returned; None starts from rest.

        Returns:
            spikes ``[T, B, ...]`` in {0, 1}, and the state after the last step.
        """
        return self.run(current, self.initial_state(current[0]) if state is None else state)

    def run(self, current: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """As ``forward``, from a given state."""
        return over_time(self.step, current, state)


def over_time(step: Step, current: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
    """Apply a step to each of the T currents ``[T, B, ...]``; returns the T spikes and the last state."""
    spikes = []
    for current_t in current:
        spikes_t, state = step(current_t, state)
        spikes.append(spikes_t)
    return torch.stack(spikes), state


def constant_or_parameter(module: nn.Module, name: str, value: float, learn: bool) -> None:
    """Give a module a scalar by name: a parameter if it is learned, else a buffer. Checkpoints hold both."""
    if learn:
        module.register_parameter(name, nn.Parameter(torch.as_tensor(value)))
    else:
        module.register_buffer(name, torch.as_tensor(value))


def unlisted(neuron: _Module) -> _Module:
    """The snnTorch neuron, without its entry in snnTorch's list.

    snnTorch keeps every neuron it ever made in one process-wide list, for its hidden-state helpers. State is explicit
    here, and the list would keep discarded networks alive.
    """
    snntorch.SpikingNeuron.instances.remove(neuron)
    return neuron
