"""NIR files in other people's simulators, bitwise on exact numbers; each is skipped where it is not installed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.parity.dyadic import dyadic_copy, dyadic_observations
from switchmt_snn.export.runtimes.agents import encode, read_nir
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.export.runtimes.simulators import SIMULATORS, simulate, skipped
from tests.export.export_cases import make_agent, observations

CASES = [(name, "portable") for name in SIMULATORS] + [("spikingjelly", "spikingjelly")]


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("name", "profile"), CASES)
@pytest.mark.parametrize("method", ["SwitchMT", "DSQN"])
def test_simulators_agree_bitwise(name: str, profile: str, method: str, tmp_path: Path) -> None:
    simulator = SIMULATORS[name]
    if not simulator.installed:
        pytest.skip(f"{name} is not installed")
    agent = dyadic_copy(make_agent(seed=2, method=method))
    x = dyadic_observations(observations(agent, 12, seed=2))
    for task in range(3):
        write_nir(nir_graph(fold_agent(agent), task, profile), tmp_path / "task.nir")  # type: ignore[arg-type]
        graph = read_nir(tmp_path / "task.nir")
        encoded = encode(agent.suite, agent.config, x, 0)
        expected, recorded = NirInterpreter(graph, **simulator.interpreter).run(encoded, ["hidden_neurons"])
        assert recorded["hidden_neurons"].any()
        assert np.array_equal(simulate(name, graph, encoded), expected), simulator.convention


def test_a_simulator_that_is_not_compared_says_why() -> None:
    leaky = nir_graph(fold_agent(make_agent(neuron="LIF")), 0)
    for name, simulator in SIMULATORS.items():
        reason = skipped(name, leaky)
        assert reason == "importers differ in what LIF means" if simulator.installed else reason.endswith("installed")
    graph = nir_graph(fold_agent(make_agent()), 0, "exact")
    assert all(skipped(name, graph) is not None for name in SIMULATORS)


def test_conventions_differ_where_they_are_said_to() -> None:
    """On exact numbers there are ties: > and >=, and the two resets, must not agree by accident."""
    agent = dyadic_copy(make_agent(seed=2))
    graph = nir_graph(fold_agent(agent), 0)
    encoded = encode(agent.suite, agent.config, dyadic_observations(observations(agent, 12, seed=2)), 0)
    outputs = [NirInterpreter(graph, **simulator.interpreter).run(encoded)[0] for simulator in SIMULATORS.values()]
    norse, nirtorch, spikingjelly, sinabs = outputs
    assert np.array_equal(norse, nirtorch)
    assert not np.array_equal(norse, spikingjelly)
    assert not np.array_equal(spikingjelly, sinabs)
