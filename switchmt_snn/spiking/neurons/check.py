"""Whether a neuron model from outside the package keeps the contract of ``NeuronLayer``; also for authors.

Shapes: T simulation steps, B batch, ... any feature shape.
"""

from __future__ import annotations

import copy
import dataclasses
import math
from contextlib import AbstractContextManager
from typing import Any, NoReturn

import numpy as np
import torch
from torch import Tensor

from switchmt_snn.config import NetworkConfig
from switchmt_snn.config.plugins import user_code
from switchmt_snn.errors import ConfigError
from switchmt_snn.spiking.apart import apart
from switchmt_snn.spiking.layers import NeuronNode
from switchmt_snn.spiking.neurons.base import NeuronLayer, NeuronState

TIMESTEPS = 8
"""Steps for which a model is played."""

CHANNELS = 5
"""Output channels of the layer that a model describes."""

_SEE = "; see docs/extending.md, Neuron"


def check_neuron(model: type[NeuronLayer], config: NetworkConfig | None = None) -> None:
    """Make a layer of the model, play it for a few steps on small tensors, and compare it with the contract.

    Checked: ``STATE``; the constructor; shape, dtype and values of spikes; number, shape and dtype of state variables,
    and that they are numbers; that a step changes neither its arguments nor the layer; that a gradient reaches the
    currents; that ``run``, if the class has its own, gives what a loop over ``step`` gives; that ``node``, likewise,
    gives a description with a number for every channel; that the layer can be copied. It draws from no random
    generator of the process, and the layer that a network gets is another one.

    Args:
        model: the class.
        config: the settings under ``network``; None takes the defaults.

    Raises:
        ConfigError: naming the class, what was seen, and what was expected.
    """
    config = NetworkConfig() if config is None else config
    _check_class(model)
    with apart():
        layer = _made(model, config)
        shapes: list[tuple[int, ...]] = [(4, config.hidden_units or 64)]
        if config.trunk != "mlp":
            shapes.append((4, 16, 3, 3))
        for shape in shapes:
            _Played(layer, shape, config.threshold).check()
        if model.node is not NeuronLayer.node:
            _check_node(layer)
        with _code(model, "cannot be copied", "a layer whose attributes copy.deepcopy takes"):
            copy.deepcopy(layer)


def _check_class(model: type[NeuronLayer]) -> None:
    ancestors = model.__mro__[: model.__mro__.index(NeuronLayer)]
    if not any("STATE" in vars(ancestor) for ancestor in ancestors):
        _refuse(model, "states no STATE", 'the names of its state variables, as STATE = ("membrane",)')
    names: Any = model.STATE
    plain = isinstance(names, tuple) and all(isinstance(name, str) and name.isidentifier() for name in names)
    if not plain or len(set(names)) < len(names):
        _refuse(model, f"has STATE = {names!r}", 'a tuple of plain names, each once, as ("membrane",) with its comma')
    if model.step is NeuronLayer.step:
        _refuse(model, "defines no step", "step(self, current_t, state) -> (spikes_t, state)")


def _made(model: type[NeuronLayer], config: NetworkConfig) -> NeuronLayer:
    with _code(model, "cannot be made", "__init__(self, config) with super().__init__(config)"):
        layer = model(config)
    if "_parameters" not in vars(layer) or not hasattr(layer, "surrogate"):
        _refuse(model, "does not call super().__init__(config)", "it as the first line of __init__(self, config)")
    return layer


def _check_node(layer: NeuronLayer) -> None:
    """The description that exporters and counters read."""
    model = type(layer)
    with _code(model, "fails in node", "node(self, channels) -> NeuronNode, with kind and states"):
        node: Any = layer.node(CHANNELS)
        kind, states = (node.kind, node.states) if isinstance(node, NeuronNode) else (None, None)
    if not isinstance(node, NeuronNode):
        _refuse(model, f"returns {_kind(node)} from node({CHANNELS})", "a dataclass derived from NeuronNode")
    if not isinstance(kind, str):
        _refuse(model, f"has a node whose kind is {kind!r}", "the model's name, a text")
    if not (isinstance(states, tuple) and all(isinstance(name, str) for name in states)):
        _refuse(model, f"has a node whose states are {states!r}", 'a tuple of names, as ("membrane",) with its comma')
    for field in dataclasses.fields(node):
        values = getattr(node, field.name)
        if not field.name.endswith("_O"):
            continue
        if not (isinstance(values, np.ndarray) and values.shape == (CHANNELS,) and values.dtype.kind in "fiu"):
            shown = f"an array of shape {values.shape}" if isinstance(values, np.ndarray) else _kind(values)
            expected = f"an array of {CHANNELS} numbers, one for each channel, as np.full(channels, value)"
            _refuse(model, f"has {shown} as {field.name} from node({CHANNELS})", expected)
        if not bool(np.isfinite(values).all()):
            _refuse(model, f"has {field.name} = {values.tolist()} from node({CHANNELS})", "finite numbers")


class _Played:
    """A layer over a few steps of currents around its threshold, so that some neurons fire and others do not.

    Half of the currents go from -1 to 3 thresholds; half from -4 to 4, for surrogates that are 0 near the threshold.
    """

    def __init__(self, layer: NeuronLayer, shape: tuple[int, ...], threshold: float) -> None:
        self._layer, self._model = layer, type(layer)
        count = math.prod(shape)
        near, wide = torch.linspace(-1.0, 3.0, count // 2) * threshold, torch.linspace(-4.0, 4.0, count - count // 2)
        spread = torch.cat([near, wide])[torch.randperm(count)].view(1, *shape)
        self._leaf = spread.repeat(TIMESTEPS, *(1,) * len(shape)).requires_grad_()
        self._current = self._leaf * 1.0  # no leaf: autograd lets a step change it, and it is seen

    def check(self) -> None:
        first = state = self._initial()
        spikes = []
        for step in range(TIMESTEPS):
            spikes_t, state = self._step(self._current[step], state)
            spikes.append(spikes_t)
        self._require_gradient(torch.stack(spikes))
        if self._model.run is not NeuronLayer.run:
            self._require_run(first, torch.stack(spikes), state)

    def _require_run(self, first: NeuronState, spikes: Tensor, last: NeuronState) -> None:
        """``run`` is a faster form of the loop over ``step``, not another model."""
        expected = "the spikes and the last state of a loop over step: (spikes, state)"
        with _code(self._model, "fails in run", expected):
            result = self._layer.run(self._current, first)
        if not (isinstance(result, tuple) and len(result) == 2 and isinstance(result[0], Tensor)):
            _refuse(self._model, f"returns {_kind(result)} from run", expected)
        self._require_state("run", result[1], last)
        if result[0].shape != spikes.shape or not torch.equal(result[0], spikes):
            _refuse(self._model, "gives other spikes in run than in step", expected)
        for name, ours, theirs in zip(self._model.STATE, result[1], last, strict=True):
            if not torch.allclose(ours, theirs, rtol=1e-4, atol=1e-5):
                _refuse(self._model, f"gives another {name} in run than in step", expected)

    def _initial(self) -> NeuronState:
        current_t = self._current[0]
        with _code(self._model, "fails in initial_state", "the state at rest"):
            state = self._layer.initial_state(current_t)
        self._require_state("initial_state", state, None)
        return state

    def _step(self, current_t: Tensor, state: NeuronState) -> tuple[Tensor, NeuronState]:
        """One step, compared with the contract."""
        arguments = {"current_t": current_t, **dict(zip(self._model.STATE, state, strict=True))}
        versions = {name: argument._version for name, argument in arguments.items()}
        before = _contents(self._layer)
        names = ", ".join(self._model.STATE) or "none"
        expected = f"a step for currents of shape {tuple(current_t.shape)} and the state variables of STATE ({names})"
        with _code(self._model, "fails in step", expected):
            result = self._layer.step(current_t, state)
        self._require_unchanged(before)
        for name, argument in arguments.items():
            if argument._version != versions[name]:
                _refuse(self._model, f"changes {name} in place in step", "a new tensor, v = v + x")
        if not (isinstance(result, tuple) and len(result) == 2):
            _refuse(self._model, f"returns {_kind(result)} from step", "(spikes_t, state)")
        self._require_spikes(result[0])
        self._require_state("step", result[1], state)
        return result

    def _require_unchanged(self, before: dict[str, tuple[Any, int]]) -> None:
        after = _contents(self._layer)
        for name in [*before, *after]:
            old, new = before.get(name), after.get(name)
            if old is None or new is None or old[0] is not new[0] or old[1] != new[1]:
                _refuse(
                    self._model,
                    f"changes its attribute {name!r} in step",
                    "a step that changes neither its arguments nor the layer; name what it remembers in STATE, and "
                    "return it in the state",
                )

    def _require_spikes(self, spikes: Any) -> None:
        current_t = self._current[0]
        if not isinstance(spikes, Tensor) or (spikes.shape, spikes.dtype) != (current_t.shape, current_t.dtype):
            _refuse(
                self._model,
                f"gives {_kind(spikes)} as spikes for currents of shape {tuple(current_t.shape)}",
                f"{_kind(current_t)}",
            )
        other = spikes[(spikes != 0) & (spikes != 1)]  # NaN, too
        if other.numel():
            _refuse(self._model, f"gives {other[0].item():g} as a spike", "0 or 1, as self.surrogate(u) gives")

    def _require_state(self, method: str, state: Any, before: NeuronState | None) -> None:
        names = self._model.STATE
        if not (isinstance(state, tuple) and all(isinstance(variable, Tensor) for variable in state)):
            _refuse(self._model, f"returns {_kind(state)} as state from {method}", "a tuple of tensors, as (v,)")
        if len(state) != len(names):
            _refuse(
                self._model,
                f"returns {len(state)} state variables from {method}",
                f"{len(names)}, those of STATE ({', '.join(names) or 'none'})",
            )
        rest = (self._current[0],) * len(names) if before is None else before
        for name, variable, old in zip(names, state, rest, strict=True):
            same = variable.shape[:1] == old.shape[:1] if before is None else variable.shape == old.shape
            if not same or variable.dtype != old.dtype:
                _refuse(self._model, f"returns {name} as {_kind(variable)} from {method}", f"{_kind(old)}")
            if bool(variable.isnan().any()):
                _refuse(self._model, f"gives {name} as NaN in {method}", "numbers for currents of -4 to 4 thresholds")

    def _require_gradient(self, spikes: Tensor) -> None:
        """A gradient of zero is refused only if some neurons fired and others did not: then some came near."""
        expected = "one; spikes come from self.surrogate(u - threshold), not from a comparison"
        if not spikes.requires_grad:
            _refuse(self._model, "gives spikes without a gradient to the currents", expected)
        (gradient,) = torch.autograd.grad(spikes.sum(), self._leaf, allow_unused=True)
        silent = gradient is None or not bool(gradient.any())
        if silent and 0 < float(spikes.detach().mean()) < 1:
            _refuse(self._model, "gives spikes whose gradient to all currents is 0", expected)


def _contents(layer: NeuronLayer) -> dict[str, tuple[Any, int]]:
    """Attributes, parameters and buffers of a layer by name, each with its version, which a change in place raises."""
    tensors = {**dict(layer.named_parameters()), **dict(layer.named_buffers())}
    named = {**vars(layer), **tensors}
    return {name: (value, value._version if isinstance(value, Tensor) else 0) for name, value in named.items()}


def _kind(value: Any) -> str:
    """A tensor's type and shape, or a value's type."""
    if isinstance(value, Tensor):
        return f"a {str(value.dtype).removeprefix('torch.')} tensor of shape {tuple(value.shape)}"
    return f"a {type(value).__name__}" if value is not None else "None"


def _subject(model: type[NeuronLayer]) -> str:
    return f"the neuron {model.__module__}:{model.__qualname__}"


def _code(model: type[NeuronLayer], seen: str, expected: str) -> AbstractContextManager[None]:
    return user_code(f"{_subject(model)} {seen}", f"{expected}{_SEE}")


def _refuse(model: type[NeuronLayer], seen: str, expected: str) -> NoReturn:
    raise ConfigError(f"{_subject(model)} {seen}, expected {expected}{_SEE}")
