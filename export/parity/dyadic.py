"""A dyadic copy of an agent: every number a multiple of a power of two, so that float32 arithmetic is exact.

Where nothing is rounded, the order of sums cannot matter, and two programs that compute the same network must agree
bitwise. A difference on the copy is an error in an export, never rounding.
"""

from __future__ import annotations

import copy
import math
from dataclasses import replace
from functools import singledispatch
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from switchmt_snn.acting.agent import Agent
from switchmt_snn.errors import ExportError
from switchmt_snn.export.parity.activity import chunks
from switchmt_snn.export.runtimes.agents import encode
from switchmt_snn.machine.cores import all_cores
from switchmt_snn.spiking.dendrites import ActiveDendrites
from switchmt_snn.spiking.network import Stream
from switchmt_snn.spiking.neurons import AdaptiveLayer, LeakyLayer, NeuronLayer, ReLULayer, SynapticLayer
from switchmt_snn.spiking.normalization import TaskBatchNorm

_DYADIC_BETAS = (0.0, 0.5, 0.75, 0.875)
"""Decays whose 1 - beta is a power of two, so that tau = dt / (1 - beta) is exact, too."""
_WEIGHT_BITS = (5, 4, 3, 2)
_MIN_RATE = 0.01
_MAX_HALVINGS = 6
_ANN_WEIGHTS_PER_UNIT = 16
"""An ANN's activations grow bits layer by layer; with this many weights of +-1 per unit they stay below 2^24."""


def exact_copy(agent: Agent, observations_by_task: list[npt.NDArray[Any]]) -> tuple[Agent, bool]:
    """A dyadic copy with as many bits as stay exact, in which no layer is silent.

    Args:
        agent: the trained network.
        observations_by_task: dyadic observations ``[B, *shape]`` of each task.

    Returns:
        The copy, and whether nothing rounds on these observations.
    """
    for bits in _WEIGHT_BITS:
        twin = dyadic_copy(agent, bits)
        wake_silent_layers(twin, observations_by_task)
        with all_cores() as pool:
            jobs = [
                pool.submit(is_exact, twin, task, chunk, seed)
                for task, observations in enumerate(observations_by_task)
                for seed, chunk in enumerate(chunks(observations))
            ]
            exact = all(job.result() for job in jobs)
        if exact:
            return twin, True
    return twin, False


def dyadic_copy(agent: Agent, weight_bits: int = 5) -> Agent:
    """A copy of the same shape whose weights, normalisation, gains and input scale are dyadic.

    Args:
        agent: the trained network.
        weight_bits: bits of a weight's magnitude, relative to the largest of its layer.
    """
    network = copy.deepcopy(agent.network)
    with torch.no_grad():
        for module in network.modules():
            if isinstance(module, (nn.Conv2d, nn.Linear)):
                _round_synapses(module, network.spiking, weight_bits)
            elif isinstance(module, TaskBatchNorm):
                _round_normalization(module, network.spiking)
            elif isinstance(module, ActiveDendrites):
                _round_dendrites(module)
            elif isinstance(module, NeuronLayer):
                round_neurons(module)
        for name, stream in network.streams.items():
            outputs = network.observation.num_actions if name != "value" else 1
            _exact_means(cast(Stream, stream).head, network.config.quantiles, outputs, name == "advantage")
    scale = agent.suite.scale if math.log2(agent.suite.scale).is_integer() else 2.0**-8
    network.observation = replace(network.observation, scale=scale)
    return Agent(network, replace(agent.suite, scale=scale), agent.config, torch.device("cpu"), agent.step)


def wake_silent_layers(agent: Agent, observations_by_task: list[npt.NDArray[Any]]) -> None:
    """Halve the threshold of layers in which hardly a neuron fires in some task: a silent layer would prove nothing.

    Args:
        agent: a dyadic copy, changed in place.
        observations_by_task: dyadic observations ``[B, *shape]`` of each task.
    """
    network = agent.network
    layers = {**dict(network.trunk.items()), **dict(network.streams.items())}
    # The streams are one layer of an export, and some simulators want one threshold per layer.
    for names in [*([name] for name in network.trunk), list(network.streams)]:
        for _ in range(_MAX_HALVINGS if network.spiking else 0):
            rates = []
            for task, observations in enumerate(observations_by_task):
                activity: dict[str, Tensor] = {}
                with torch.inference_mode():
                    network.eval()(torch.from_numpy(observations[::4].copy()), task, activity=activity)
                rates += [float(activity[name].mean()) for name in names]
            if min(rates) >= _MIN_RATE:
                break
            with torch.no_grad():
                for name in names:
                    threshold_of(cast(Any, layers[name]).neurons).div_(2.0)


def is_exact(agent: Agent, task: int, observations: npt.NDArray[Any], seed: int = 0) -> bool:
    """Whether the network computes the same in float32 and in float64: then nothing was rounded.

    ``seed`` is of a random encoding. Rounding of Q by a mean over T that is no power of two is left out; the spikes
    decide.
    """
    # snnTorch's neurons write into themselves; copies keep calls from several threads apart.
    same_bits, wide = copy.deepcopy(agent.network), copy.deepcopy(agent.network).double()
    for module in wide.modules():
        if isinstance(module, NeuronLayer):
            module.surrogate = _step  # snnTorch's surrogates answer in float32
            for neuron in module.children():
                neuron.spike_grad = _step  # type: ignore[assignment]
    scaled = torch.from_numpy(encode(agent.suite, agent.config, observations, seed).copy())
    narrow_activity: dict[str, torch.Tensor] = {}
    wide_activity: dict[str, torch.Tensor] = {}
    narrow, wide_q = (
        _from_encoded(network, scaled.to(dtype), task, activity)
        for network, dtype, activity in (
            (same_bits, torch.float32, narrow_activity),
            (wide, torch.float64, wide_activity),
        )
    )
    same = all(torch.equal(narrow_activity[name].double(), wide_activity[name]) for name in wide_activity)
    T = agent.config.network.timesteps
    return same and (T & (T - 1) != 0 or torch.equal(narrow.double(), wide_q))


def _step(x: torch.Tensor) -> torch.Tensor:
    return (x > 0).to(x.dtype)


def _from_encoded(network: Any, encoded: torch.Tensor, task: int, activity: dict[str, torch.Tensor]) -> torch.Tensor:
    """Run a network on inputs that are encoded already."""
    replaced = copy.copy(network)
    replaced.encoder = lambda x, generator: encoded
    replaced.observation = network.observation
    with torch.inference_mode():
        q: torch.Tensor = replaced.eval()(torch.zeros(1, dtype=encoded.dtype), task, activity=activity)
    return q


def dyadic_observations(observations: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Observations with few enough bits for exact sums: the upper four of a byte, or sixteenths within +-8."""
    if observations.dtype == np.uint8:
        return np.bitwise_and(observations, 0xF0) if observations.max(initial=0) > 1 else observations
    rounded: npt.NDArray[Any] = np.clip(np.rint(observations * 16), -128, 128) / 16
    return rounded.astype(observations.dtype)


def _to_grid(value: Tensor, bits: int) -> Tensor:
    return torch.round(value * 2.0**bits) / 2.0**bits


def _dyadic_decay(value: Tensor | float) -> float:
    """Of a decay as the neurons use it, within [0, 1]; no decay stays none, so that a copy has the same nodes."""
    decay = min(max(float(value), 0.0), 1.0)
    return decay if decay == 1.0 else min(_DYADIC_BETAS, key=lambda near: abs(near - decay))


@singledispatch
def round_neurons(layer: NeuronLayer) -> None:
    """Make a layer's parameters dyadic, in place; a membrane that does not decay stays so. One rule per class."""
    raise ExportError(_no_rule(layer))


def cannot_copy(agent: Agent) -> str | None:
    """Why an agent has no dyadic copy: its neurons are of a class without rules; None if it has one."""
    none = round_neurons.dispatch(object), threshold_of.dispatch(object)
    for module in agent.network.modules():
        if isinstance(module, NeuronLayer) and not isinstance(module, ReLULayer):
            rules = round_neurons.dispatch(type(module)), threshold_of.dispatch(type(module))
            if any(rule is default for rule, default in zip(rules, none, strict=True)):
                return _no_rule(module)
    return None


def _no_rule(layer: NeuronLayer) -> str:
    return (
        f"{type(layer).__module__}:{type(layer).__name__} has no rule that makes its parameters dyadic, expected "
        "round_neurons and threshold_of of switchmt_snn.export.parity.dyadic (docs/extending.md, Neuron)"
    )


@round_neurons.register
def _(layer: ReLULayer) -> None:
    pass


@round_neurons.register
def _(layer: LeakyLayer) -> None:
    _round_threshold(layer)
    layer.leaky.beta.fill_(_dyadic_decay(layer.leaky.beta))


@round_neurons.register
def _(layer: SynapticLayer) -> None:
    _round_threshold(layer)
    layer.synaptic.alpha.fill_(_dyadic_decay(layer.synaptic.alpha))
    layer.synaptic.beta.fill_(_dyadic_decay(layer.synaptic.beta))


@round_neurons.register
def _(layer: AdaptiveLayer) -> None:
    _round_threshold(layer)
    layer.beta.fill_(_dyadic_decay(layer.beta))
    layer.decay, layer.strength = _dyadic_decay(layer.decay), max(0.125, round(layer.strength * 8) / 8)


def _round_threshold(layer: NeuronLayer) -> None:
    threshold = threshold_of(layer)
    threshold.copy_(_to_grid(threshold, 3).clamp(min=0.125))


@singledispatch
def threshold_of(layer: NeuronLayer) -> Tensor:
    """The threshold (at rest) of a layer's neurons, to be changed in place."""
    raise ExportError(_no_rule(layer))


@threshold_of.register
def _(layer: LeakyLayer) -> Tensor:
    return cast(Tensor, layer.leaky.threshold)


@threshold_of.register
def _(layer: SynapticLayer) -> Tensor:
    return cast(Tensor, layer.synaptic.threshold)


@threshold_of.register
def _(layer: AdaptiveLayer) -> Tensor:
    return layer.threshold


def _round_synapses(module: nn.Conv2d | nn.Linear, spiking: bool, bits: int) -> None:
    if spiking:
        exponent = math.ceil(math.log2(max(float(module.weight.abs().max()), 2.0**-20)))
        module.weight.copy_(_to_grid(module.weight, bits - exponent))
    else:
        flat = module.weight.flatten(1)
        kept = torch.zeros_like(flat)
        largest = flat.abs().topk(min(_ANN_WEIGHTS_PER_UNIT, flat.shape[1]), dim=1).indices
        module.weight.copy_(kept.scatter(1, largest, torch.sign(flat).gather(1, largest)).view_as(module.weight))
    if module.bias is not None:
        module.bias.copy_(_to_grid(module.bias, 4))


def _round_normalization(module: TaskBatchNorm, spiking: bool) -> None:
    """1 / sqrt(var + epsilon) becomes a power of two; epsilon one, too, so that the variance is exact."""
    module.epsilon = 2.0**-10
    inverse = torch.round(-0.5 * torch.log2(module.running_var_KC + module.epsilon)).clamp(-3, 3)
    if not spiking:
        inverse.zero_()
    module.running_var_KC.copy_(2.0 ** (-2 * inverse) - module.epsilon)
    module.running_mean_KC.copy_(_to_grid(module.running_mean_KC, 4))
    module.bias.copy_(_to_grid(module.bias, 4))
    module.weight.copy_(_to_grid(module.weight, 2) if spiking else torch.sign(module.weight))


def _round_dendrites(module: ActiveDendrites) -> None:
    """Every gain becomes a multiple of 1/8: a float32 response is searched whose sigmoid is exactly that."""
    rows, _, tasks = module.segments_NSK.shape
    for task in range(tasks):
        gain = (_to_grid(module(task), 3)).clamp(0.125, 0.875)
        response = torch.logit(gain)
        # All segments alike: the largest, and the largest in absolute value, is then this one.
        candidates = [response]
        for direction in (torch.inf, -torch.inf):
            moved = response
            for _ in range(8):
                moved = torch.nextafter(moved, torch.full_like(moved, direction))
                candidates.append(moved)
        best, error = response, torch.full_like(response, torch.inf)
        for candidate in candidates:
            module.segments_NSK[:, :, task] = candidate.view(rows, 1)
            missed = (module(task) - gain).abs()
            best, error = torch.where(missed < error, candidate, best), torch.minimum(missed, error)
        module.segments_NSK[:, :, task] = best.view(rows, 1)


def _exact_means(head: nn.Linear, quantiles: int, outputs: int, over_actions: bool) -> None:
    """Means over actions and over quantiles that are exact for any number of them.

    Advantages sum to zero over the actions. Quantiles lie in pairs around the first one, with equal distances.
    """
    half = quantiles // 2
    for part in (head.weight, head.bias):
        for sets in part.unflatten(0, (-1, quantiles, outputs)):  # views: [M, outputs, ...], one per head of a task
            if over_actions:
                sets[:, -1] = -sets[:, :-1].sum(1)
            center, distances = sets[0].clone(), sets[:half].clone()
            sets[:half], sets[half : 2 * half], sets[2 * half :] = center + distances, center - distances, center
