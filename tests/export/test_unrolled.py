"""``unrolled.onnx``: the same operators without Scan, for every network that spikes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import helper

from switchmt_snn.config import METHOD_TRAITS
from switchmt_snn.errors import ExportError
from switchmt_snn.export import to_onnx
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats import onnx_writer
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.runtimes.agents import OnnxAgent, encode
from switchmt_snn.spiking.folding import quantized
from tests.export.export_cases import VARIANTS, RunCommand, make_agent, observations

SPIKING = [name for name, of in VARIANTS.items() if METHOD_TRAITS[of.get("method", "SwitchMT")].spiking]


@pytest.mark.slow
@pytest.mark.parametrize("variant", SPIKING)
def test_an_unrolled_file_is_bitwise_the_file_with_scan(variant: str) -> None:
    agent = make_agent(**VARIANTS[variant])
    network, x, tasks = fold_agent(agent), observations(agent, 9), np.arange(9) % 3
    for folded, task in ((network, None), (network, 1), (quantized(network), None)):
        model = decision_model(folded, task, unroll=True)
        used = {name for node in model.graph.node for name in node.input}
        assert {one.name for one in model.graph.initializer} <= used, "onnxruntime warns of what no node takes"
        assert "Scan" not in {node.op_type for node in model.graph.node}
        with_scan = decision_model(folded, task)
        encoded = encode(agent.suite, agent.config, x, 0)
        one, other = (
            OnnxAgent(m.SerializeToString(), agent.suite, agent.config).decide(x, tasks, encoded)
            for m in (model, with_scan)
        )
        assert one.keys() == other.keys() == {"q_values", "spike_counts"}
        assert all(np.array_equal(one[name], other[name]) for name in one)
        assert one["spike_counts"].any()


def test_what_cannot_be_unrolled_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ExportError, match="DQN has no simulation steps, expected a spiking method to unroll"):
        to_onnx(make_agent(method="DQN"), "unrolled")
    branch = helper.make_graph([], "branch", [], [])
    written = onnx_writer.export_neurons

    def with_a_branch(neurons, graph, layer, current):
        graph.add("If", ["condition"], f"{layer.name}_either", then_branch=branch, else_branch=branch)
        return written(neurons, graph, layer, current)

    monkeypatch.setattr(onnx_writer, "export_neurons", with_a_branch)
    with pytest.raises(ExportError, match=r"If\) has a graph of its own, expected none in a step that is unrolled"):
        decision_model(fold_agent(make_agent()), unroll=True)


@pytest.mark.slow
def test_export_unroll_writes_and_compares_the_file(trained_run: Path, run_command: RunCommand) -> None:
    run_command("export", trained_run, "--onnx", "--unroll", "--parity-decisions", 40)
    model = onnx.load(trained_run / "export" / "unrolled.onnx")
    assert {entry.key for entry in model.metadata_props} >= {"tasks", "config_sha256"}
    parity = json.loads((trained_run / "export" / "parity.json").read_text())
    for rows in (parity["dyadic"], parity["recorded"]):
        assert {row["runtime"] for row in rows} == {"onnx", "onnx, unrolled"}
    assert all(row["bitwise"] for row in parity["dyadic"])
    assert all(sum(row["spikes"].values()) > 0 for row in parity["dyadic"])
    _, err = run_command("export", trained_run, "--nir", "--unroll", code=2)
    assert "--unroll writes unrolled.onnx, expected --onnx with it" in err
