"""The proof of an export: exact numbers, recorded play, stored integers, other simulators; and what failed."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import nir
import numpy as np
import numpy.typing as npt

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import dialect_of, nir_graph
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.export.parity.compare import MIN_EQUAL_ACTIONS, Comparison, Exports, compare
from switchmt_snn.export.parity.dyadic import cannot_copy, dyadic_observations, exact_copy
from switchmt_snn.export.runtimes.agents import OnnxAgent, encode
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.export.runtimes.simulators import SIMULATORS, quietly, simulate, skipped
from switchmt_snn.machine.cores import all_cores
from switchmt_snn.spiking.folding import FoldedNetwork

DYADIC_DECISIONS = 32
SIMULATOR_DECISIONS = 16

Observations = npt.NDArray[Any]


def prove(agent: Agent, written: Exports, observations: Iterable[Observations]) -> dict[str, Any]:
    """Compare exported models with the network that they came from.

    Args:
        agent: the trained network.
        written: the models, as read back.
        observations: raw observations ``[N, *shape]`` of each task in turn; taken one by one, so that they may still
            be coming.

    Returns:
        The content of ``parity.json``; ``failures`` is empty if everything agrees as it must.
    """
    return _Proof(agent, written).check(observations)


class _Proof:
    def __init__(self, agent: Agent, written: Exports) -> None:
        self.agent, self.written = agent, written
        self.int8 = written.network.head.weight_steps_O is not None
        self.failures: list[str] = []

    def check(self, observations: Iterable[Observations]) -> dict[str, Any]:
        """All comparisons as plain values."""
        real, stored, exact_inputs = [], [], []
        names = self.agent.suite.names
        for task, recorded in enumerate(observations):
            exact_inputs.append(dyadic_observations(_spread(recorded, DYADIC_DECISIONS)))
            for comparison in compare(self.agent, self.written, task, recorded):
                real.append(comparison.to_dict())
                if not self.int8 and comparison.equal_actions_share < MIN_EQUAL_ACTIONS:
                    self.failures.append(
                        f"{names[task]}, {comparison.runtime}: {comparison.equal_actions_share:.1%} equal actions, "
                        f"first difference in layer {comparison.first_difference}"
                    )
            if self.int8 and self.written.decision is not None:
                stored.append(self._stored_integers(self.written.decision, task, recorded))
        return {
            **self._exact(exact_inputs),
            "recorded": real,
            "int8_storage": stored,
            "criteria": {"dyadic": "bitwise", "recorded_min_equal_actions": MIN_EQUAL_ACTIONS},
            "failures": self.failures,
        }

    def _exact(self, exact_inputs: list[Observations]) -> dict[str, Any]:
        """Comparisons on the dyadic copy; for neurons that have none, why they were left out."""
        dyadic: list[dict[str, Any]] = []
        simulators: list[dict[str, Any]] = []
        left_out: dict[str, str] = {}
        reason = cannot_copy(self.agent)
        if reason is None:
            twin, exact = exact_copy(self.agent, exact_inputs)
            if not exact:
                self.failures.append(
                    "every dyadic copy rounds, so the bitwise check proves nothing (please report this)"
                )
            copied = self._same_kinds(fold_agent(twin))
            for task, name in enumerate(self.agent.suite.names):
                for comparison in compare(twin, copied, task, exact_inputs[task]):
                    dyadic.append(comparison.to_dict() | {"exact_arithmetic": exact})
                    if exact and not self._agrees(comparison):
                        self.failures.append(
                            f"{name}, {comparison.runtime}: not bitwise equal on exact numbers, first in layer "
                            f"{comparison.first_difference}"
                        )
            if copied.graphs is not None:
                simulators = self._simulators(twin, copied.graphs, exact_inputs)
                first = next(iter(copied.graphs.values()))
                left_out = {name: why for name in SIMULATORS if (why := skipped(name, first)) is not None}
        elif self.written.graphs is not None:
            left_out = dict.fromkeys(SIMULATORS, "compared on the exact copy only")
        return {
            "dyadic": dyadic,
            "dyadic_skipped": reason,
            "simulators": simulators,
            "simulators_skipped": left_out,
        }

    def _agrees(self, comparison: Comparison) -> bool:
        """Bitwise; where T is no power of two, the mean over T rounds, and Q is compared to rounding."""
        T = self.agent.config.network.timesteps
        if T & (T - 1) == 0:
            return comparison.bitwise
        return comparison.decisions_with_flips == 0 and comparison.largest_q_difference < 1e-5

    def _same_kinds(self, network: FoldedNetwork) -> Exports:
        """Another network in the formats that were written."""
        written, names = self.written, network.tasks
        graphs = None
        if written.graphs is not None:
            dialect = dialect_of(next(iter(written.graphs.values())))
            graphs = {name: nir_graph(network, k, dialect) for k, name in enumerate(names)}
        return Exports(
            network,
            decision_model(network).SerializeToString() if written.decision is not None else None,
            step_model(network).SerializeToString() if written.step is not None else None,
            graphs,
            {name: decision_model(network, names.index(name)).SerializeToString() for name in written.own_decisions},
            decision_model(network, unroll=True).SerializeToString() if written.unrolled is not None else None,
        )

    def _stored_integers(self, decision: bytes, task: int, recorded: Observations) -> dict[str, Any]:
        """The int8 file against a float32 graph with the same rounded weights: only the storage may differ."""
        floats = self.written.network.with_synapses(lambda node: replace(node, weight_steps_O=None))
        stored, plain = (
            OnnxAgent(model, self.agent.suite, self.agent.config).q_values(recorded, task)
            for model in (decision, decision_model(floats).SerializeToString())
        )
        name = self.agent.suite.names[task]
        equal = float((stored.argmax(axis=1) == plain.argmax(axis=1)).mean())
        if equal < MIN_EQUAL_ACTIONS:
            self.failures.append(f"{name}: the int8 file does not decide as its own integers do ({equal:.1%})")
        return {"task": name, "decisions": len(stored), "equal_actions_share": equal}

    def _simulators(
        self, twin: Agent, graphs: dict[str, nir.NIRGraph], exact_inputs: list[Observations]
    ) -> list[dict[str, Any]]:
        """Every installed simulator on the dyadic graphs, against the interpreter under the same convention."""
        names = [name for name in SIMULATORS if skipped(name, next(iter(graphs.values()))) is None]

        def simulated(task: str, name: str) -> dict[str, Any]:
            simulator, recorded = SIMULATORS[name], exact_inputs[twin.suite.index(task)]
            inputs_TB = encode(twin.suite, twin.config, _spread(recorded, SIMULATOR_DECISIONS), 0)
            reset = str(graphs[task].metadata["reset"])
            expected, _ = NirInterpreter(graphs[task], reset=reset, **simulator.interpreter).run(inputs_TB)
            refused, equal = None, False
            try:
                equal = bool(np.array_equal(expected, simulate(name, graphs[task], inputs_TB)))
            except (
                AssertionError,
                ValueError,
                NotImplementedError,
            ) as error:  # it says itself that it cannot read such a network
                refused = str(error)
            return {
                "simulator": name,
                "task": task,
                "convention": simulator.convention,
                "decisions": inputs_TB.shape[1],
                "bitwise": equal,
                "refused": refused,
            }

        with quietly(), all_cores() as pool:
            rows = list(pool.map(simulated, *zip(*itertools.product(graphs, names), strict=True))) if names else []
        self.failures += [
            f"{row['task']}, {row['simulator']}: not bitwise equal under its convention ({row['convention']})"
            for row in rows
            if not row["bitwise"] and row["refused"] is None
        ]
        return rows


def _spread(observations: Observations, count: int) -> Observations:
    """Some observations from all over a recording."""
    chosen = np.linspace(0, len(observations) - 1, min(count, len(observations))).astype(np.int64)
    return np.ascontiguousarray(observations[chosen])
