"""Parity: does an exported file decide as the trained network does?

(a) bitwise, on a dyadic copy of the network, where no sum rounds; (b) on the real weights and recorded play, where
rounding may flip a spike near the threshold: how often, and does the action change.

Shapes: T simulation steps, B batch (decisions), L neuron layers, A actions.
"""

from __future__ import annotations

import copy
from dataclasses import asdict, dataclass, field
from typing import Any

import nir
import numpy as np
import numpy.typing as npt
import onnxruntime

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.parity.activity import active_neurons, chunks
from switchmt_snn.export.runtimes.agents import OnnxAgent, encode, onnx_session
from switchmt_snn.export.runtimes.nir_interpreter import Float, NirInterpreter
from switchmt_snn.machine.cores import all_cores
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.spiking.folding import FoldedNetwork

MIN_EQUAL_ACTIONS = 0.99
"""On real weights, an export that agrees on fewer actions fails."""


@dataclass(frozen=True)
class Trace:
    """What a batch of decisions did.

    Attributes:
        q_BA: Q-values, as a host sees them: nothing is masked here.
        spikes: each layer's spikes ``[T, B, N]``, as far as they can be seen (an ANN has none).
        counts: each layer's number of spikes ``[B]``, where a model counts them itself.
        step_q_BA: Q-values of the same decisions by ``step.onnx``, if there is one.
    """

    q_BA: Float
    spikes: dict[str, npt.NDArray[np.bool_]]
    counts: dict[str, npt.NDArray[np.int64]] = field(default_factory=dict)
    step_q_BA: Float | None = None


@dataclass
class Comparison:
    """Decisions of a runtime against those of the trained network.

    Attributes:
        spikes: by layer, in forward order: of the trained network.
        flipped_spikes: by layer: a spike that is there in one and missing in the other, at any step.
        decisions_with_flips: decisions with at least one.
        largest_q_difference: over actions that exist.
        equal_q: decisions with bitwise equal Q.
        equal_actions: decisions with the same greedy action.
    """

    runtime: str
    task: str
    decisions: int = 0
    spikes: dict[str, int] = field(default_factory=dict)
    flipped_spikes: dict[str, int] = field(default_factory=dict)
    decisions_with_flips: int = 0
    largest_q_difference: float = 0.0
    equal_q: int = 0
    equal_actions: int = 0

    def merge(self, other: Comparison) -> None:
        """Add the counts of other decisions."""
        for mine, theirs in ((self.spikes, other.spikes), (self.flipped_spikes, other.flipped_spikes)):
            for name, count in theirs.items():
                mine[name] = mine.get(name, 0) + count
        self.decisions += other.decisions
        self.decisions_with_flips += other.decisions_with_flips
        self.largest_q_difference = max(self.largest_q_difference, other.largest_q_difference)
        self.equal_q += other.equal_q
        self.equal_actions += other.equal_actions

    def add(self, expected: Trace, seen: Trace) -> None:
        """Count one batch."""
        flips_B = np.zeros(len(expected.q_BA), np.int64)
        for name, spikes in expected.spikes.items():
            flips_here_B = np.zeros(len(flips_B), np.int64)
            if name in seen.spikes:
                flips_here_B = (spikes != seen.spikes[name]).sum(axis=(0, 2))
            if name in seen.counts:
                flips_here_B = np.maximum(flips_here_B, np.abs(spikes.sum(axis=(0, 2)) - seen.counts[name]))
            self.spikes[name] = self.spikes.get(name, 0) + int(spikes.sum())
            self.flipped_spikes[name] = self.flipped_spikes.get(name, 0) + int(flips_here_B.sum())
            flips_B += flips_here_B
        exists = np.isfinite(expected.q_BA)
        equal_q_B, equal_actions_B = (np.ones(len(flips_B), np.bool_) for _ in range(2))
        for q_BA in (seen.q_BA, seen.step_q_BA):
            if q_BA is not None:
                difference = np.abs(np.where(exists, expected.q_BA, 0) - np.where(exists, q_BA, 0))
                self.largest_q_difference = max(self.largest_q_difference, float(difference.max(initial=0.0)))
                equal_q_B &= (difference == 0).all(axis=1)
                equal_actions_B &= expected.q_BA.argmax(axis=1) == q_BA.argmax(axis=1)
        self.decisions += len(flips_B)
        self.decisions_with_flips += int((flips_B > 0).sum())
        self.equal_q += int(equal_q_B.sum())
        self.equal_actions += int(equal_actions_B.sum())

    @property
    def bitwise(self) -> bool:
        """Whether everything was equal."""
        return self.decisions_with_flips == 0 and self.equal_q == self.decisions

    @property
    def equal_actions_share(self) -> float:
        """Share of decisions with the same action."""
        return self.equal_actions / self.decisions

    @property
    def first_difference(self) -> str:
        """The first layer that differs, in words."""
        return next(
            (name for name, flips in self.flipped_spikes.items() if flips), "head" if not self.bitwise else "none"
        )

    def to_dict(self) -> dict[str, Any]:
        """Plain values."""
        return asdict(self) | {"bitwise": self.bitwise, "equal_actions_share": self.equal_actions_share}


def trace_torch(agent: Agent, observations: npt.NDArray[Any], task: int, seed: int) -> Trace:
    """The trained network itself; the streams' layers side by side as ``hidden``."""
    activity = active_neurons(agent, observations, task, seed)
    return Trace(activity.q_BA, activity.by_layer if agent.network.spiking else {})


def trace_nir(network: FoldedNetwork, interpreter: NirInterpreter, encoded_TB: Float) -> Trace:
    """A NIR graph in the reference interpreter."""
    names = {layer.name: f"{layer.name}_neurons" for layer in network.layers}
    outputs, recorded = interpreter.run(encoded_TB, list(names.values()))
    return Trace(network.readout(outputs), {name: _flat(recorded[node]) > 0 for name, node in names.items()})


def trace_onnx(
    network: FoldedNetwork,
    decision: OnnxAgent,
    step: onnxruntime.InferenceSession | None,
    observations: npt.NDArray[Any],
    encoded_TB: Float,
    task: int,
) -> Trace:
    """``decision.onnx`` for Q and spike counts, ``step.onnx`` (if given) for every spike and Q once more."""
    batch = len(observations)
    tasks_B = np.full(batch, task)
    decided = decision.decide(observations, tasks_B, encoded_TB)
    layers = network.layers
    counts_BL = decided.get("spike_counts")
    counts = {} if counts_BL is None else {layer.name: counts_BL[:, index] for index, layer in enumerate(layers)}
    if step is None:
        return Trace(decided["q_values"], {}, counts)
    shapes = {
        f"{state}_{layer.name}": (batch, *layer.output_shape) for layer in layers for state in layer.neurons.states
    }
    states = {name: np.zeros(shape, np.float32) for name, shape in shapes.items()}
    spikes: dict[str, list[npt.NDArray[np.bool_]]] = {layer.name: [] for layer in layers}
    outputs: list[Float] = []
    names = [value.name for value in step.get_outputs()]
    takes_task = any(value.name == "task" for value in step.get_inputs())
    for encoded_B in encoded_TB:
        fed = {"encoded": np.ascontiguousarray(encoded_B), **states, **({"task": tasks_B} if takes_task else {})}
        out = dict(zip(names, step.run(names, fed), strict=True))
        states = {name: out[f"{name}_next"] for name in states}
        outputs.append(out["q_step"])
        for name, values in spikes.items():
            values.append(out[f"spikes_{name}"].reshape(batch, -1) > 0)
    fired = {name: np.stack(values) for name, values in spikes.items()}
    return Trace(decided["q_values"], fired, counts, network.readout(np.stack(outputs)))


def _flat(values_TB: Float) -> Float:
    return values_TB.reshape(*values_TB.shape[:2], -1)


@dataclass(frozen=True)
class Exports:
    """Exported models to compare with a network; None where a kind was not exported."""

    network: FoldedNetwork
    decision: bytes | None = None
    step: bytes | None = None
    graphs: dict[str, nir.NIRGraph] | None = None
    own_decisions: dict[str, bytes] = field(default_factory=dict)
    """``decision_<task>.onnx`` by task."""
    unrolled: bytes | None = None


def compare(agent: Agent, exports: Exports, task: int, observations: npt.NDArray[Any]) -> list[Comparison]:
    """Compare every exported model of a task with the network on some observations.

    Chunks are compared side by side on all cores; PyTorch and NumPy run on one thread each meanwhile.
    """
    name, network = agent.suite.names[task], exports.network
    own = OnnxAgent(exports.own_decisions[name], agent.suite, agent.config) if name in exports.own_decisions else None
    there = {
        "onnx": exports.decision,
        "onnx, unrolled": exports.unrolled,
        "onnx, one task": own,
        "nir": exports.graphs,
    }
    runtimes = [runtime for runtime, model in there.items() if model is not None]
    decision, unrolled = (
        OnnxAgent(model, agent.suite, agent.config) if model is not None else None
        for model in (exports.decision, exports.unrolled)
    )
    step = onnx_session(exports.step) if exports.step is not None else None

    def compared(seed: int, chunk: npt.NDArray[Any]) -> list[Comparison]:
        # snnTorch's neurons write into themselves: every thread has a network of its own.
        mine = Agent(copy.deepcopy(agent.network), agent.suite, agent.config, agent.device, agent.step)
        expected = trace_torch(mine, chunk, task, seed)
        encoded_TB = encode(agent.suite, agent.config, chunk, seed)
        results = [Comparison(runtime, name) for runtime in runtimes]
        for result in results:
            if result.runtime == "onnx" and decision is not None:
                result.add(expected, trace_onnx(network, decision, step, chunk, encoded_TB, task))
            elif result.runtime == "onnx, unrolled" and unrolled is not None:
                result.add(expected, trace_onnx(network, unrolled, None, chunk, encoded_TB, task))
            elif result.runtime == "onnx, one task" and own is not None:
                result.add(expected, trace_onnx(network, own, None, chunk, encoded_TB, task))
            elif exports.graphs is not None:
                interpreter = NirInterpreter(exports.graphs[name], reset=str(exports.graphs[name].metadata["reset"]))
                result.add(expected, trace_nir(network, interpreter, encoded_TB))
        return results

    totals = [Comparison(runtime, name) for runtime in runtimes]
    progress = progress_of(f"comparing {', '.join(runtimes)} on {name}", len(observations), "decisions")
    with progress as work, all_cores() as pool:
        for results in pool.map(compared, *zip(*enumerate(chunks(observations)), strict=True)):
            for total, result in zip(totals, results, strict=True):
                total.merge(result)
            work.advance(totals[0].decisions - work.done)
    return totals
