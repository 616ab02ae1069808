"""Files in other people's runtimes: every cell of the table in docs/deploy.md; skipped where one is not installed."""

from __future__ import annotations

import functools
import importlib.util
import re
from collections.abc import Callable
from pathlib import Path

import nir
import numpy as np
import onnx
import pytest
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.errors import ExportError
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.parity.compare import trace_torch
from switchmt_snn.export.parity.dyadic import dyadic_copy, dyadic_observations
from switchmt_snn.export.runtimes.agents import encode, onnx_session, read_nir
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.export.runtimes.simulators import SIMULATORS, quietly, simulate, skipped
from switchmt_snn.spiking.neurons.leaky import LeakyLayer
from tests.export.export_cases import make_agent, observations

DOCUMENT = Path(__file__).parents[2] / "docs" / "deploy.md"
Run = Callable[[nir.NIRGraph, np.ndarray], np.ndarray]
"""Outputs per step for encoded inputs ``[T, B, ...]``."""


def spyx(graph: nir.NIRGraph, encoded: np.ndarray) -> np.ndarray:
    import jax.numpy as jnp
    from spyx.nir import from_nir

    _, outputs = from_nir(graph, jnp.asarray(encoded), float(graph.metadata["dt"]))
    return np.asarray(outputs)


def openvino(path: Path, fed: dict[str, np.ndarray]) -> np.ndarray:
    import openvino

    model = openvino.Core().compile_model(path, "CPU", {"INFERENCE_PRECISION_HINT": "f32"})
    return model(fed)["q_values"]


def tract(path: Path, fed: dict[str, np.ndarray]) -> np.ndarray:
    import tract

    return tract.onnx().load(path).into_model().into_runnable().run(list(fed.values()))[0].to_numpy()


def opencv(path: Path, fed: dict[str, np.ndarray]) -> np.ndarray:
    import cv2

    model = cv2.dnn.readNetFromONNX(str(path))
    for name, value in fed.items():
        model.setInput(value, name)
    return model.forward("q_values")


ONNX_RUNTIMES: dict[str, tuple[str, Callable[[Path, dict[str, np.ndarray]], np.ndarray]]] = {
    "onnxruntime 1.31": ("onnxruntime", lambda path, fed: onnx_session(path).run(["q_values"], fed)[0]),
    "OpenVINO 2026.4": ("openvino", openvino),
    "tract 0.23": ("tract", tract),
    "OpenCV 5.0": ("cv2", opencv),
}
"""Module and function ``(path, inputs by name) -> Q`` by the table's first column."""
RUNTIMES: dict[str, tuple[str, Run]] = {
    "NIR interpreter": ("nir", lambda graph, x: NirInterpreter(graph, reset=str(graph.metadata["reset"])).run(x)[0]),
    "spyx 1.0": ("spyx", spyx),
    **{
        row: (name, functools.partial(simulate, name))
        for row, name in {
            "norse 1.1": "norse",
            "nirtorch 2.6": "nirtorch",
            "SpikingJelly 2.0": "spikingjelly",
            "sinabs 3.1": "sinabs",
            "snnTorch 1.0 importer": "snntorch",
        }.items()
    },
}
"""Module and function by the table's first column."""


def table() -> list[tuple[str, str, str, str, str]]:
    """Runtime, file, neuron, reset and result of each cell."""
    (rows,) = re.findall(r"\| runtime \|.*?\n\|[-|]+\n((?:\|.*\n)+)", DOCUMENT.read_text())
    cells = []
    for row in rows.splitlines():
        runtime, _, file, *results = (cell.strip() for cell in row.strip("|").split("|"))
        kinds = [("IF", "zero"), ("IF", "subtract"), ("LIF", "zero"), ("LIF", "subtract")]
        cells += [(runtime, file, *kind, result) for kind, result in zip(kinds, results, strict=True)]
    return cells


@functools.cache
def network(neuron: str, reset: str, trunk: str) -> tuple[Agent, np.ndarray, np.ndarray]:
    """An exact copy, observations of which some put a membrane on its threshold, and Q of task 1."""
    agent = dyadic_copy(make_agent(seed=2, neuron=neuron, reset=reset, beta=0.75, trunk=trunk))
    x = dyadic_observations(observations(agent, 12, seed=2))
    return agent, x, trace_torch(agent, x, 1, 0).q_BA


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(("runtime", "file", "neuron", "reset", "result"), table())
def test_every_cell_of_the_table_is_true(
    runtime: str, file: str, neuron: str, reset: str, result: str, tmp_path: Path
) -> None:
    """On vectors (mlp) and, where they run, on images. Exact numbers have ties: > and >= differ."""
    for trunk in ("mlp", "minatar") if result in ("exact", "at") else ("mlp",):
        agent, x, q = network(neuron, reset, trunk)
        if file.endswith(".onnx"):
            module, decide = ONNX_RUNTIMES[runtime]
            if importlib.util.find_spec(module) is None:
                pytest.skip(f"{module} is not installed")
            onnx.save(decision_model(fold_agent(agent), unroll=file == "unrolled.onnx"), tmp_path / file)
            if result == "refused":
                with pytest.raises(Exception):  # noqa: B017, PT011 - whatever it raises
                    decide(tmp_path / file, {"observation": x, "task": np.ones(len(x), np.int64)})
                continue
            assert result == "exact"
            for rows in (slice(None), slice(1)):  # any batch
                fed = {"observation": x[rows], "task": np.ones(len(x[rows]), np.int64)}
                assert np.array_equal(decide(tmp_path / file, fed), q[rows])
            continue
        if result == "not written":
            with pytest.raises(ExportError, match="reset"):
                nir_graph(fold_agent(agent), 1, file)
            continue
        module, run = RUNTIMES[runtime]
        needed = SIMULATORS[module].modules if module in SIMULATORS else (module,)
        if missing := [name for name in needed if importlib.util.find_spec(name) is None]:
            pytest.skip(f"{', '.join(missing)} not installed")
        write_nir(nir_graph(fold_agent(agent), 1, file), tmp_path / "task.nir")
        graph, encoded = read_nir(tmp_path / "task.nir"), np.ascontiguousarray(encode(agent.suite, agent.config, x, 0))
        if module in SIMULATORS:
            assert (skipped(module, graph) is None) == (result in ("exact", "at")), "export compares what runs"
        if result == "refused":
            with pytest.raises(Exception):  # noqa: B017, PT011 - whatever the importer raises
                run(graph, encoded)
            continue
        with quietly():
            seen = run(graph, encoded)
        at, _ = NirInterpreter(graph, reset=str(graph.metadata["reset"]), fires_at_threshold=True).run(encoded)
        found = "exact" if np.array_equal(seen.mean(0), q) else "at" if np.array_equal(seen, at) else "wrong"
        # Where no membrane meets its threshold, both conventions agree.
        assert found == result or (result == "at" and np.array_equal(at.mean(0), q)), found


def test_the_table_has_every_runtime_and_every_cell_a_known_word() -> None:
    words = {"exact", "at", "wrong", "refused", "not written"}
    assert {result for *_, result in table()} == words
    assert {runtime for runtime, *_ in table()} == {*RUNTIMES, *ONNX_RUNTIMES}


def test_a_simulator_that_is_not_compared_says_why() -> None:
    leaky = nir_graph(fold_agent(make_agent(neuron="LIF")), 0)
    reasons = {name: skipped(name, leaky) for name, simulator in SIMULATORS.items() if simulator.installed}
    assert reasons.get("norse") is None
    only = "does not take the dialect portable, only spikingjelly"
    assert reasons.get("snntorch", only) == only
    assert reasons.get("sinabs", "refuses LIF").startswith("refuses LIF")
    loops = nir_graph(fold_agent(make_agent(reset="subtract")), 0, "exact")
    assert {name for name in SIMULATORS if skipped(name, loops) is None} <= {"nirtorch"}


def test_neurons_of_one_layer_with_several_tau_are_not_for_the_importer_that_takes_one() -> None:
    """Value and advantage stream are one layer of a file; learned, each has a beta of its own. norse runs that."""
    agent = make_agent(neuron="LIF", learn_beta=True)
    betas = [module.leaky.beta for module in agent.network.modules() if isinstance(module, LeakyLayer)]
    with torch.no_grad():
        for beta, value in zip(betas, (0.2, 0.85, 0.6), strict=True):
            beta.fill_(value)
    graph = nir_graph(fold_agent(agent), 1, "spikingjelly")
    x = encode(agent.suite, agent.config, observations(agent, 12), 0)
    expected, _ = NirInterpreter(graph).run(x)
    assert np.allclose(expected.mean(0), trace_torch(agent, observations(agent, 12), 1, 0).q_BA, atol=1e-5)
    if not SIMULATORS["snntorch"].missing:
        assert str(skipped("snntorch", graph)).startswith("scales every threshold of a layer by one tau")
        with quietly():
            assert not np.allclose(simulate("snntorch", graph, x), expected, atol=0.01)
    portable = nir_graph(fold_agent(agent), 1)
    if skipped("norse", portable) is None:
        with quietly():
            assert np.allclose(simulate("norse", portable, x), expected, atol=1e-5)


def test_conventions_differ_where_they_are_said_to() -> None:
    """On exact numbers there are ties: > and >=, and the two resets, must not agree by accident."""
    agent, x, _ = network("IF", "zero", "minatar")
    graph, encoded = nir_graph(fold_agent(agent), 0), encode(agent.suite, agent.config, x, 0)
    above, at = (NirInterpreter(graph, fires_at_threshold=at).run(encoded)[0] for at in (False, True))
    subtracts, _ = NirInterpreter(graph, reset="subtract").run(encoded)
    assert not np.array_equal(above, at)
    assert not np.array_equal(above, subtracts)
