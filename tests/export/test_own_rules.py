"""Neurons and encodings from outside the package in exports and profiles: with rules of their own, and without."""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from switchmt_snn import load_config, train
from switchmt_snn.acting.agent import Agent
from switchmt_snn.errors import ExportError
from switchmt_snn.export import check_parity, to_onnx
from switchmt_snn.export.formats.onnx_encodings import RULES, encoding_rule
from switchmt_snn.export.formats.onnx_graph import Graph
from switchmt_snn.spiking.encodings import Encoding
from tests.export.export_cases import RunCommand, make_agent, observations
from tests.recipes import code_of

STEPS = 160


class OnOff(Encoding):
    """The values and their complements, the same at every step."""

    makes_spikes = False
    constant_over_time = True
    needs_unit_range = True

    @classmethod
    def channels(cls, observation_channels: int, frame_stack: int) -> int:
        """Twice as many."""
        return 2 * observation_channels

    def encode(self, x: Tensor, generator: torch.Generator | None) -> Tensor:
        """``[1, B, 2C, ...]``."""
        return torch.cat([x, 1.0 - x], dim=1).unsqueeze(0)


class Latency(OnOff):
    """Named like a built-in encoding."""


def on_off(graph: Graph, x: str) -> str:
    off = graph.add("Sub", [graph.constant("one", 1.0), x], "off")
    return graph.add("Concat", [x, off], "both", axis=1)


@pytest.fixture
def rule() -> Iterator[Callable[[Any], Agent]]:
    """``rule(function)`` registers an ONNX rule of ``OnOff`` for one test and returns an agent."""

    def register(function: Any) -> Agent:
        encoding_rule(OnOff)(function)
        return make_agent(encoding=f"{__name__}:OnOff")

    yield register
    RULES.pop(OnOff, None)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        (
            lambda graph, network, x: graph.add(
                "Unsqueeze", [on_off(graph, x), graph.constant("a", np.array([0]))], "u"
            ),
            r"shape \(1, batch, 12, 10, 10\), expected FLOAT of shape \(batch, 12, 10, 10\), without the T",
        ),
        (lambda graph, network, x: x, r"shape \(batch, 6, 10, 10\), expected FLOAT of shape \(batch, 12, 10, 10\)"),
        (lambda graph, network, x: graph.add("Cast", [on_off(graph, x)], "whole", to=7), r"gave INT64 of shape"),
        (
            lambda graph, network, x: graph.add("Unsqueeze", [x, graph.constant("axes", [0])], "u"),
            "adds operators that ONNX refuses .*Unsqueeze",
        ),
        (lambda graph, network, x: None, "returned None, expected the name of a value that the rule adds"),
    ],
)
def test_a_wrong_onnx_rule_of_an_encoding_is_one_line(rule: Any, wrong: Any, message: str) -> None:
    agent = rule(wrong)
    with pytest.raises(ExportError, match=rf"the ONNX rule of network\.encoding {__name__}:OnOff .*{message}") as error:
        to_onnx(agent)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_right_onnx_rule_of_an_encoding_passes_the_bitwise_check(rule: Any) -> None:
    agent = rule(lambda graph, network, x: on_off(graph, x))
    played = {name: observations(agent, 8) for name in agent.suite.names}
    result = check_parity(agent, played)
    assert result["failures"] == []
    assert {row["runtime"] for row in result["dyadic"]} == {"onnx", "nir"}


def test_an_encoding_without_a_rule_is_named_by_its_module() -> None:
    agent = make_agent(encoding=f"{__name__}:Latency")
    with pytest.raises(ExportError, match=rf"{__name__}:Latency, expected one of direct, latency, frames, events;"):
        to_onnx(agent)


def test_constants_keep_the_dtype_of_integer_arrays_and_make_floats_of_numbers() -> None:
    graph = Graph()
    for name, value in (("a", np.array([1, 2])), ("b", np.array([True])), ("c", [1, 2]), ("d", 3), ("e", np.zeros(2))):
        graph.constant(name, value)
    kinds = [str(constant.data_type) for constant in graph.constants.values()]
    assert kinds == ["7", "9", "1", "1", "1"], "INT64, BOOL, FLOAT"


@pytest.fixture
def recipes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The modules and configs of docs/extending.md, sections Neuron and Encoding."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    names = []
    for block in (*code_of("Neuron"), *code_of("Encoding")):
        first = block.splitlines()[0]
        if first.startswith("# ") and first.endswith((".py", ".yaml")):
            names.append(first[2:])
            (tmp_path / first[2:]).write_text(block)
    yield tmp_path
    for name in names:
        sys.modules.pop(name.removesuffix(".py"), None)


def trained(config: str) -> Path:
    loaded = replace(load_config(config), total_steps=STEPS, threads=1, device="cpu")
    return train(loaded, "run").path


@pytest.mark.slow
def test_an_encoding_without_an_onnx_rule_is_profiled_and_exported_to_nir(
    recipes: Path, run_command: RunCommand
) -> None:
    run = trained("own_encoding.yaml")
    out, _ = run_command("profile", run, "--decisions", 20, "--target", "cmos45-fp32", "--target", "loihi-2")
    told = " ".join(out.split())
    assert "do to the actions is left out: ONNX has no rule for network.encoding my_encodings:Thermometer" in told
    facts = json.loads((run / "profile" / "profile.json").read_text())
    assert facts["tasks"][0]["energy"][0]["total_pj"] > 0
    assert (facts["chips"][0]["chip"], facts["tasks"][0]["precision"]) == ("loihi-2", [])
    assert "What rounded weights do to the actions is left out" in (run / "profile" / "report.html").read_text()
    out, _ = run_command("export", run, "--parity-decisions", 20)
    assert "left out ONNX: ONNX has no rule for network.encoding my_encodings:Thermometer" in out
    assert {path.suffix for path in (run / "export").iterdir()} == {".nir", ".json", ".md"}
    assert list(json.loads((run / "export" / "parity.json").read_text())["left_out"]) == ["onnx"]
    _, err = run_command("export", run, "--onnx", code=2)
    assert "ONNX has no rule" in err


@pytest.mark.slow
def test_an_own_neuron_without_rules_is_counted_and_no_format_is_said_to_fit(
    recipes: Path, run_command: RunCommand
) -> None:
    run = trained("own_neuron.yaml")
    out, _ = run_command("profile", run, "--decisions", 20, "--target", "loihi-2")
    assert "No energy target was chosen" in out
    _, err = run_command("export", run, code=2)
    assert len(err.strip().splitlines()) == 1
    for name in ("ONNX", "NIR"):
        assert f"{name} cannot express my_neurons:PartialReset" in err
    assert err.count("docs/extending.md, Neuron") == 2
    assert "--onnx" not in err
    assert "--nir" not in err


@pytest.mark.slow
def test_an_own_neuron_with_rules_is_exported_compared_and_counted(recipes: Path, run_command: RunCommand) -> None:
    run = trained("exported_neuron.yaml")
    out, _ = run_command("export", run, "--parity-decisions", 20)
    assert "left out NIR: PartialReset is a loop" in out
    out, _ = run_command("export", run, "--nir-dialect", "exact", "--parity-decisions", 50)
    assert "the exact check was left out: my_exported_neurons:ExportedPartialReset has no rule" in " ".join(out.split())
    parity = json.loads((run / "export" / "parity.json").read_text())
    assert [row["runtime"] for row in parity["recorded"]] == ["onnx", "nir"]
    assert all(row["equal_actions_share"] == 1.0 for row in parity["recorded"])
    assert all(sum(row["spikes"].values()) > 0 for row in parity["recorded"])
    run_command("profile", run, "--decisions", 20, "--target", "loihi-2")
    facts = json.loads((run / "profile" / "profile.json").read_text())
    assert facts["tasks"][0]["precision"][0]["bits"] == 8
    assert "neuron kind my_neurons:PartialReset" in facts["chips"][0]["layers"][0]["not_held"]
    assert facts["tasks"][0]["layers"][0]["states"] == 1


@pytest.mark.slow
def test_an_own_neuron_with_dyadic_rules_is_compared_bitwise(recipes: Path) -> None:
    agent = make_agent(neuron="my_bitwise_neurons:BitwisePartialReset")
    result = check_parity(agent, {name: observations(agent, 8) for name in agent.suite.names}, dialect="exact")
    assert result["failures"] == []
    assert result["dyadic_skipped"] is None
    assert all(row["bitwise"] and row["exact_arithmetic"] for row in result["dyadic"])
    assert {row["runtime"] for row in result["dyadic"]} == {"onnx", "nir"}
