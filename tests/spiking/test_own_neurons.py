"""``check_neuron``: each mistake in a neuron from outside the package gives one line that names it."""

from __future__ import annotations

import random
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor, nn

from switchmt_snn.config import NetworkConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.layers import NeuronNode
from switchmt_snn.spiking.neurons import NEURONS, SURROGATES, NeuronLayer, check_neuron, make_neuron_layer

THIS = "tests.spiking.test_own_neurons"


class Good(NeuronLayer):
    """Integrates, and starts from zero after a spike."""

    STATE = ("membrane",)

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.threshold = config.threshold
        self.share = nn.Parameter(torch.rand(()))

    def step(self, current_t: Tensor, state: Any) -> Any:
        (membrane,) = state
        membrane = membrane + current_t
        spikes = self.surrogate(membrane - self.threshold)
        return spikes, (membrane * (1.0 - self.share * spikes.detach()),)


class Stateless(NeuronLayer):
    STATE = ()

    def step(self, current_t: Tensor, state: Any) -> Any:
        return self.surrogate(current_t - 1.0), ()


class ThreeValues(Good):
    """Keeps three values for each neuron, whose rest it states."""

    def initial_state(self, current_t: Tensor) -> Any:
        return (torch.zeros(*current_t.shape, 3),)

    def step(self, current_t: Tensor, state: Any) -> Any:
        (delayed,) = state
        delayed = torch.cat([delayed[..., 1:], current_t[..., None]], dim=-1)
        return self.surrogate(delayed[..., 0] - self.threshold), (delayed,)


class NoState(NeuronLayer):
    def step(self, current_t: Tensor, state: Any) -> Any:
        return self.surrogate(current_t), state


class NoStep(NeuronLayer):
    STATE = ("membrane",)


class StateText(Good):
    STATE = "membrane"  # type: ignore[assignment]


class StateTwice(Good):
    STATE = ("membrane", "membrane")


class TooMany(Good):
    STATE = ("membrane", "slow")

    def step(self, current_t: Tensor, state: Any) -> Any:
        return super().step(current_t, state[:1])


class TooFew(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, (membrane,) = super().step(current_t, state)
        return spikes, (membrane, spikes)


class NoSuper(Good):
    def __init__(self, config: NetworkConfig) -> None:
        self.threshold = config.threshold


class NoConfig(Good):
    def __init__(self) -> None:
        super().__init__(NetworkConfig())


class Misspelt(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        return self.surrogat(current_t), state


class Remembers(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, (self.last,) = super().step(current_t, state)
        return spikes, (self.last,)


class Adapts(Good):
    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.register_buffer("mean", torch.zeros(()))

    def step(self, current_t: Tensor, state: Any) -> Any:
        self.mean += 1.0
        return super().step(current_t, state)


class ChangesState(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        state[0].mul_(0.5)
        return super().step(current_t, state)


class ChangesCurrent(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        current_t *= 0.5
        return super().step(current_t, state)


class NotCopied(Good):
    def __init__(self, config: NetworkConfig) -> None:
        super().__init__(config)
        self.steps = (step for step in range(3))


class SpikesOnly(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        return super().step(current_t, state)[0]


class BareState(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, (membrane,) = super().step(current_t, state)
        return spikes, membrane


class FlatSpikes(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, state = super().step(current_t, state)
        return spikes.amax(-1), state


class OneColumn(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, state = super().step(current_t, state)
        return spikes.amax(-1, keepdim=True), state


class TruthValues(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, state = super().step(current_t, state)
        return spikes.bool(), state


class Graded(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        _, state = super().step(current_t, state)
        return state[0], state


class NarrowState(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, (membrane,) = super().step(current_t, state)
        return spikes, (membrane.mean(-1, keepdim=True),)


class NoSurrogate(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, state = super().step(current_t, state)
        return spikes.detach(), state


class GradientOfShareOnly(Good):
    def step(self, current_t: Tensor, state: Any) -> Any:
        spikes, state = super().step(current_t, state)
        return spikes.detach() + self.share - self.share.detach(), state


class WrongRest(Good):
    def initial_state(self, current_t: Tensor) -> Any:
        return torch.zeros_like(current_t)


class RunsAnother(Good):
    """Its faster form is another model."""

    def run(self, current: torch.Tensor, state: Any) -> Any:
        return self.surrogate(current - self.threshold), state


class RunsAnotherState(Good):
    def run(self, current: torch.Tensor, state: Any) -> Any:
        spikes, last = super().run(current, state)
        return spikes, (last[0] + 1.0,)


class RunsBare(Good):
    def run(self, current: torch.Tensor, state: Any) -> Any:
        return super().run(current, state)[0]


class NoNumber(Good):
    def step(self, current_t: torch.Tensor, state: Any) -> Any:
        spikes, (membrane,) = super().step(current_t, state)
        return spikes, (membrane.log(),)


@dataclass(frozen=True)
class GoodNode(NeuronNode):
    threshold_O: Any
    kind = "good"
    states = Good.STATE


class Described(Good):
    def node(self, channels: int) -> Any:
        return GoodNode(np.full(channels, self.threshold))


class FailsInNode(Good):
    def node(self, channels: int) -> Any:
        return GoodNode(np.full(channels, self.treshold))


class NoNode(Good):
    def node(self, channels: int) -> Any:
        return None


class ShortNode(Good):
    def node(self, channels: int) -> Any:
        return GoodNode(np.full(2, self.threshold))


class NumberNode(Good):
    def node(self, channels: int) -> Any:
        return GoodNode(self.threshold)


class NaNNode(Good):
    def node(self, channels: int) -> Any:
        return GoodNode(np.full(channels, np.nan))


@dataclass(frozen=True)
class NamelessNode(NeuronNode):
    states = Good.STATE


class NamelessDescription(Good):
    def node(self, channels: int) -> Any:
        return NamelessNode()


@dataclass(frozen=True)
class CommalessNode(NeuronNode):
    kind = "good"
    states = "membrane"  # type: ignore[assignment]


class CommalessDescription(Good):
    def node(self, channels: int) -> Any:
        return CommalessNode()


MISTAKES = {
    RunsAnother: "gives other spikes in run than in step",
    RunsAnotherState: "gives another membrane in run than in step",
    RunsBare: r"returns a float32 tensor of shape .* from run",
    NoNumber: "gives membrane as NaN in step",
    NoState: "states no STATE",
    NoStep: "defines no step",
    StateText: "has STATE = 'membrane', expected a tuple",
    StateTwice: "each once",
    TooMany: r"returns 1 state variables from step, expected 2, those of STATE \(membrane, slow\)",
    TooFew: r"returns 2 state variables from step, expected 1",
    NoSuper: r"does not call super\(\).__init__\(config\)",
    NoConfig: r"cannot be made \(TypeError: .*expected __init__\(self, config\)",
    Misspelt: r"fails in step \(AttributeError: .*'surrogat'",
    Remembers: "changes its attribute 'last' in step",
    Adapts: "changes its attribute 'mean' in step",
    ChangesState: "changes membrane in place",
    ChangesCurrent: "changes current_t in place",
    NotCopied: "cannot be copied",
    SpikesOnly: r"returns a float32 tensor of shape .* from step, expected \(spikes_t, state\)",
    BareState: "as state from step, expected a tuple of tensors",
    FlatSpikes: r"gives a float32 tensor of shape \(4,\) as spikes for currents of shape \(4, 8\)",
    OneColumn: r"gives a float32 tensor of shape \(4, 1\) as spikes",
    TruthValues: r"gives a bool tensor",
    Graded: "as a spike, expected 0 or 1",
    NarrowState: r"returns membrane as a float32 tensor of shape \(4, 1\)",
    NoSurrogate: "without a gradient to the currents",
    GradientOfShareOnly: "whose gradient to all currents is 0",
    FailsInNode: r"fails in node \(AttributeError: .*'treshold'",
    NoNode: r"returns None from node\(5\), expected a dataclass derived from NeuronNode",
    ShortNode: r"has an array of shape \(2,\) as threshold_O from node\(5\), expected an array of 5 numbers",
    NumberNode: r"has a float as threshold_O from node\(5\), expected an array of 5 numbers",
    NaNNode: r"has threshold_O = \[nan, .*expected finite numbers",
    NamelessDescription: r"fails in node \(NotImplementedError: NamelessNode defines no kind, expected a property",
    CommalessDescription: "has a node whose states are 'membrane', expected a tuple of names",
    WrongRest: "from initial_state, expected a tuple of tensors",
}


@pytest.mark.parametrize("model", MISTAKES, ids=lambda model: model.__name__)
def test_a_mistake_in_a_neuron_is_named_before_a_layer_is_made(model: type[NeuronLayer]) -> None:
    config = NetworkConfig(neuron=f"{THIS}:{model.__name__}", hidden_units=8)  # type: ignore[arg-type]
    with pytest.raises(ConfigError, match=MISTAKES[model]) as refused:
        make_neuron_layer(config, spiking=True)
    assert f"the neuron {THIS}:{model.__name__} " in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize("model", [Good, Stateless, ThreeValues, Described, *dict.fromkeys(NEURONS.values())])
@pytest.mark.parametrize("trunk", ["mlp", "nature"])
def test_a_neuron_that_keeps_the_contract_is_taken(model: type[NeuronLayer], trunk: Any) -> None:
    check_neuron(model, NetworkConfig(trunk=trunk, hidden_units=8))


@pytest.mark.parametrize("surrogate", SURROGATES)
def test_every_surrogate_gives_a_gradient_to_the_check(surrogate: Any) -> None:
    check_neuron(Good, NetworkConfig(surrogate=surrogate, hidden_units=8, threshold=0.1))


def test_the_check_leaves_random_numbers_and_the_layer_as_they_were() -> None:
    """A layer of a checked class starts from the same parameters as one that is made without a check."""
    random.seed(1), np.random.seed(1), torch.manual_seed(1)
    expected = (random.random(), np.random.rand(), Good(NetworkConfig()).share.item(), torch.rand(1).item())
    random.seed(1), np.random.seed(1), torch.manual_seed(1)
    with torch.no_grad():
        layer = make_neuron_layer(NetworkConfig(neuron=f"{THIS}:Good"), spiking=True)  # type: ignore[arg-type]
    assert (random.random(), np.random.rand(), layer.share.item(), torch.rand(1).item()) == expected
