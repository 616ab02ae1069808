"""The programs of docs/deploy.md, run as they stand there."""

from __future__ import annotations

import importlib.util
import json
import re
import subprocess
import sys
from pathlib import Path

import nir
import numpy as np
import pytest

from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats.nir_writer import nir_graph, write_nir
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.parity.dyadic import dyadic_copy, dyadic_observations
from switchmt_snn.export.runtimes.agents import encode
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from switchmt_snn.export.runtimes.simulators import SIMULATORS
from switchmt_snn.runs.files import write_atomically
from tests.export.export_cases import make_agent, observations

DOCUMENT = Path(__file__).parents[2] / "docs" / "deploy.md"


def programs() -> dict[str, str]:
    """The document's programs by file name (their first line says it)."""
    blocks = re.findall(r"```python\n(.*?)```", DOCUMENT.read_text(), re.S)
    return {re.match(r'"""python (\S+)', block).group(1): block for block in blocks}


@pytest.mark.slow
def test_a_host_without_torch_and_without_this_package_plays_pong(tmp_path: Path) -> None:
    agent = make_agent(tasks={"suite": "atari", "names": ["breakout", "pong"]}, trunk="nature")
    write_atomically(tmp_path / "decision.onnx", decision_model(fold_agent(agent)).SerializeToString())
    program = programs()["play.py"]
    assert len(program.splitlines()) <= 30
    (tmp_path / "play.py").write_text(program)
    blocked = "import sys, runpy; sys.modules.update(torch=None, switchmt_snn=None); sys.argv = sys.argv[1:]; "
    code = blocked + "runpy.run_path(sys.argv[0], run_name='__main__')"
    command = [sys.executable, "-c", code, "play.py", "decision.onnx", "60"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    spikes = re.fullmatch(r"score -?\d+ after 60 decisions, (\d+) spikes per decision\n", done.stdout)
    assert spikes, done.stdout
    assert int(spikes.group(1)) > 0


@pytest.mark.slow
def test_the_host_sees_what_the_agent_saw_in_training() -> None:
    """Observations of the host's environment equal those of this package's tasks, so the scores mean the same."""
    from ale_py.vector_env import AtariVectorEnv

    from switchmt_snn.tasks.play import Play

    agent = make_agent(tasks={"suite": "atari", "names": ["pong"]}, trunk="nature")
    game = AtariVectorEnv("pong", num_envs=1, full_action_space=True, use_fire_reset=True, reward_clipping=False)
    play = Play(agent.suite, 0, 1)
    seen, _ = game.reset(seed=1)
    play.begin(np.array([0]), np.array([1]))
    for step in range(120):
        assert np.array_equal(seen, play.observations), step
        action = np.array([step % 18])
        seen, reward, *_ = game.step(action)
        assert reward[0] == play.step(action).rewards[0]
    play.close()
    game.close()


def run_program(name: str, graph: nir.NIRGraph, observation: np.ndarray, folder: Path) -> subprocess.CompletedProcess:
    write_nir(graph, folder / "task.nir")
    np.save(folder / "observation.npy", observation)
    (folder / "program.py").write_text(programs()[f"{name}_q.py"])
    command = [sys.executable, "program.py", "task.nir", "observation.npy"]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "neuron", "dialect"),
    [
        ("norse", "IF", "portable"),
        ("norse", "LIF", "portable"),
        ("spikingjelly", "IF", "portable"),
        ("spikingjelly", "LIF", "spikingjelly"),
        ("sinabs", "IF", "portable"),
        ("snntorch", "LIF", "spikingjelly"),
    ],
)
def test_programs_for_other_simulators(name: str, neuron: str, dialect: str, tmp_path: Path) -> None:
    simulator = SIMULATORS[name]
    if not simulator.installed:
        pytest.skip(f"{name} is not installed")
    agent = dyadic_copy(make_agent(seed=2, neuron=neuron))
    graph = nir_graph(fold_agent(agent), 1, dialect)
    x = dyadic_observations(observations(agent, 1, seed=3))
    done = run_program(name, graph, x[0], tmp_path)
    assert done.returncode == 0, done.stderr
    expected, _ = NirInterpreter(graph, **simulator.interpreter).run(encode(agent.suite, agent.config, x, 0))
    assert json.loads(done.stdout.splitlines()[-1]) == expected.mean(0)[0].tolist()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "module"), [("openvino", "openvino"), ("tract", "tract"), ("opencv", "cv2")])
def test_programs_for_runtimes_without_scan(name: str, module: str, tmp_path: Path) -> None:
    if importlib.util.find_spec(module) is None:
        pytest.skip(f"{module} is not installed")
    agent = dyadic_copy(make_agent(seed=2))
    x = dyadic_observations(observations(agent, 1, seed=3))
    write_atomically(tmp_path / "unrolled.onnx", decision_model(fold_agent(agent), unroll=True).SerializeToString())
    np.save(tmp_path / "observation.npy", x[0])
    (tmp_path / "program.py").write_text(programs()[f"{name}_q.py"])
    command = [sys.executable, "program.py", "unrolled.onnx", "observation.npy", "1"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1]) == agent.q_values(x, 1)[0].tolist()


@pytest.mark.slow
@pytest.mark.parametrize(("name", "neuron", "dialect"), [("sinabs", "LIF", "portable"), ("snntorch", "IF", "portable")])
def test_programs_refuse_what_their_simulator_gets_wrong(name: str, neuron: str, dialect: str, tmp_path: Path) -> None:
    if not SIMULATORS[name].installed:
        pytest.skip(f"{name} is not installed")
    agent = make_agent(trunk="mlp", neuron=neuron)
    done = run_program(name, nir_graph(fold_agent(agent), 1, dialect), observations(agent, 1)[0], tmp_path)
    assert done.returncode == 1
    assert "expected" in done.stderr
    assert "Traceback" not in done.stderr
