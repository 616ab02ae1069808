"""NIR files of other tools: the reset of the tool that wrote them, and a step that fits their time constants."""

from __future__ import annotations

import json
from pathlib import Path

import nir
import numpy as np
import pytest
import snntorch
import torch

from switchmt_snn.errors import ExportError
from switchmt_snn.export.counts.nir_file import count_nir
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.profile_run import profile_file
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from tests.export.export_cases import RunCommand, make_agent, observations


@pytest.fixture
def snntorch_file(tmp_path: Path) -> tuple[Path, Path, np.ndarray]:
    """A network of snnTorch with its default reset as its own exporter writes it, inputs, and its own outputs."""
    pytest.importorskip("nirtorch", reason="snnTorch's exporter needs nirtorch")
    from snntorch.export_nir import export_to_nir

    generator = torch.Generator().manual_seed(0)
    layers: list[torch.nn.Module] = []
    for inputs, outputs, beta in ((6, 20, 0.75), (20, 5, 0.5)):
        linear = torch.nn.Linear(inputs, outputs)
        with torch.no_grad():
            linear.weight.copy_(torch.randint(-4, 5, (outputs, inputs), generator=generator) / 4.0)
            linear.bias.copy_(torch.randint(-2, 3, (outputs,), generator=generator) / 4.0)
        decay, threshold = torch.full((outputs,), beta), torch.ones(outputs)
        layers += [linear, snntorch.Leaky(beta=decay, threshold=threshold, init_hidden=True)]
    network = torch.nn.Sequential(*layers)
    x = torch.randint(0, 3, (8, 3, 6), generator=generator) / 2.0
    graph = export_to_nir(network, x[0], ignore_dims=[0])
    for module in network.modules():
        if isinstance(module, snntorch.Leaky):
            module.mem = torch.zeros(0)
    with torch.no_grad():
        outputs_TB = np.stack([network(x_t).numpy() for x_t in x])
    nir.write(tmp_path / "snn.nir", graph)
    np.savez(tmp_path / "x.npz", inputs=x.numpy(), dt=1e-4)
    return tmp_path / "snn.nir", tmp_path / "x.npz", outputs_TB


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_file_of_snntorch_runs_as_in_snntorch_with_its_reset(snntorch_file, run_command: RunCommand) -> None:
    """Its default subtracts after the decay; subtracting at the spike, or resetting to zero, gives other spikes."""
    path, stored, expected = snntorch_file
    graph, x = nir.read(path), np.load(stored)["inputs"]
    same = {
        reset: np.array_equal(NirInterpreter(graph, 1e-4, reset=reset).run(x)[0], expected)
        for reset in ("zero", "subtract", "subtract_after_decay")
    }
    assert same == {"zero": False, "subtract": False, "subtract_after_decay": True}
    assert expected.any()
    counted = count_nir(path, stored, "subtract_after_decay")
    assert counted.counts.layers[-1].spikes_T == tuple(expected.sum(axis=(1, 2)).astype(int))
    assert counted.doubts == ()
    assert "does not say how its tool resets" in " ".join(count_nir(path, stored).doubts)
    out, _ = run_command("profile", path, "--observations", stored, "--reset", "subtract_after_decay", "--json")
    facts = json.loads(out)
    assert facts["convention"] == {"dt": 1e-4, "reset": "subtract_after_decay", "fires_at_threshold": False}
    assert sum(facts["tasks"][0]["layers"][-1]["spikes_T"]) == int(expected.sum())


def test_the_two_subtractions_by_hand() -> None:
    """v += (x - v) / 2 with x = 1.75 and threshold 1."""
    one = np.ones(1, np.float32)
    nodes = {"n": nir.LIF(tau=2 * one, r=one, v_leak=0 * one, v_threshold=one)}
    ends = {"input": nir.Input({"input": np.array([1])}), "output": nir.Output({"output": np.array([1])})}
    graph = nir.NIRGraph(ends | nodes, [("input", "n"), ("n", "output")], metadata={"dt": 1.0})
    x = np.full((3, 1, 1), 1.75, np.float32)
    # At once: 0.875; 1.3125 fires, 0.3125 left; 0.15625 + 0.875 fires. After the decay: 0.65625 + 0.875 - 1 does not.
    assert NirInterpreter(graph, reset="subtract").run(x)[0].ravel().tolist() == [0, 1, 1]
    assert NirInterpreter(graph, reset="subtract_after_decay").run(x)[0].ravel().tolist() == [0, 1, 0]
    with pytest.raises(ExportError, match="reset of NIR neurons is 'soft', expected one of zero, subtract, sub"):
        NirInterpreter(graph, reset="soft")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("dt", [1.0, 1e-3, 2.1e-4])
def test_a_step_longer_than_a_time_constant_is_refused(dt: float, snntorch_file, tmp_path: Path) -> None:
    path, stored, _ = snntorch_file
    np.savez(tmp_path / "wrong.npz", inputs=np.load(stored)["inputs"], dt=dt)
    with pytest.raises(ExportError, match=r"node \w+ has tau 0.000\d, expected dt <= tau; store dt in the file's unit"):
        count_nir(path, tmp_path / "wrong.npz")


def foreign(node: nir.NIRNode) -> nir.NIRGraph:
    ends = {"input": nir.Input({"input": np.array([2])}), "output": nir.Output({"output": np.array([2])})}
    nodes = ends | {"fc": nir.Linear(np.eye(2, dtype=np.float32)), "n": node}
    return nir.NIRGraph(nodes, [("input", "fc"), ("fc", "n"), ("n", "output")])


TWO = np.full(2, 2.0, np.float32)


def integrator(r: np.ndarray) -> nir.IF:
    return nir.IF(r=r, v_threshold=TWO, v_reset=0 * TWO)


STEPS = {
    "LIF in steps": (nir.LIF(tau=TWO, r=TWO, v_leak=0 * TWO, v_threshold=TWO), 1.0, None),
    "LIF in steps, dt of snnTorch": (nir.LIF(tau=TWO, r=TWO, v_leak=0 * TWO, v_threshold=TWO), 1e-4, "leaks 0.0002 of"),
    "CubaLIF": (
        nir.CubaLIF(tau_syn=TWO, tau_mem=1e4 * TWO, r=TWO, v_leak=0 * TWO, v_threshold=TWO, w_in=TWO),
        1.0,
        "membrane n (tau 20000) leaks",
    ),
    "IF in steps": (integrator(TWO / 2), 1.0, None),
    "IF, dt of SpikingJelly": (integrator(TWO / 2), 1e-4, "by r dt = 0.0001 per step"),
    "IF of SpikingJelly, dt in steps": (
        integrator(5e3 * TWO),
        1.0,
        "by r dt = 1e+04 per step",
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", STEPS)
def test_a_step_that_does_not_fit_the_file_is_doubted_in_the_headline(case: str, tmp_path: Path) -> None:
    node, dt, doubt = STEPS[case]
    nir.write(tmp_path / "f.nir", foreign(node))
    np.savez(tmp_path / "x.npz", inputs=np.ones((4, 3, 2), np.float32), dt=dt)
    result = profile_file(tmp_path / "f.nir", tmp_path / "x.npz", reset="zero")
    if doubt is None:
        assert result.facts["doubts"] == []
    else:
        (seen,) = result.facts["doubts"]
        assert doubt in seen
        assert result.facts["headline"].startswith(seen)


@pytest.mark.slow
def test_a_file_of_ours_has_no_doubts_and_takes_no_other_convention(tmp_path: Path, run_command: RunCommand) -> None:
    agent = make_agent(neuron="LIF", beta=0.9999, timesteps=1)
    write_nir(nir_graph(fold_agent(agent), 0), tmp_path / "own.nir")
    np.savez(tmp_path / "x.npz", observations=observations(agent, 3))
    counted = count_nir(tmp_path / "own.nir", tmp_path / "x.npz")
    assert (counted.doubts, counted.convention.reset) == ((), "zero")
    words = ("profile", tmp_path / "own.nir", "--observations", tmp_path / "x.npz", "--reset", "subtract")
    _, err = run_command(*words, code=2)
    assert "a reset was stated for a file that switchmt-snn wrote, expected its own (zero)" in err
    _, err = run_command("profile", "--reset", "subtract", code=2)
    assert "are for NIR files, expected neither for a run" in err
