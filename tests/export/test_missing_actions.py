"""Actions that a task does not have, and tasks that a network does not have: no file answers with one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import onnx.reference
import pytest
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.export.folded import fold_agent
from switchmt_snn.export.formats import nir_writer
from switchmt_snn.export.formats.nir_writer import nir_graph
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.export.parity.compare import Exports, compare
from switchmt_snn.export.runtimes.agents import encode, onnx_session
from switchmt_snn.export.runtimes.nir_interpreter import NirInterpreter
from tests.export.export_cases import make_agent, observations

MASKED = {"tasks": {"minimal_action_mask": True}}


def wrong_actions_preferred(**network: object) -> tuple[Agent, np.ndarray]:
    """An agent whose head prefers actions that task 1 does not have, and which actions task 1 has."""
    agent = make_agent(**MASKED, **network)
    valid_A = agent.suite.valid_actions_KA[1]
    assert not valid_A.all()
    with torch.no_grad():
        agent.network.streams["advantage"].head.bias[torch.from_numpy(~valid_A)] += 50.0
    return agent, valid_A


@pytest.mark.parametrize("readout", ["mean", "last_membrane", "max_membrane"])
def test_a_host_that_takes_the_largest_nir_output_never_plays_a_missing_action(readout: str) -> None:
    agent, valid_A = wrong_actions_preferred(readout=readout, readout_beta=0.0 if readout == "max_membrane" else 0.5)
    network, x = fold_agent(agent), observations(agent, 40)
    outputs, _ = NirInterpreter(nir_graph(network, 1)).run(encode(agent.suite, agent.config, x, 0))
    assert valid_A[outputs.argmax(axis=-1)].all(), "at every step, so under every readout"
    assert (network.readout(outputs).argmax(axis=1) == agent.act(x, 1)).all()
    assert np.isfinite(outputs).all()


@pytest.mark.parametrize("task", [None, 1])
def test_a_host_that_takes_the_largest_q_step_never_plays_a_missing_action(task: int | None) -> None:
    agent, valid_A = wrong_actions_preferred()
    network, x = fold_agent(agent), observations(agent, 40)
    session = onnx_session(step_model(network, task).SerializeToString())
    encoded = np.ascontiguousarray(encode(agent.suite, agent.config, x, 0)[0])
    fed = {
        value.name: np.zeros((len(x), *value.shape[1:]), np.float32)
        for value in session.get_inputs()
        if value.name not in ("encoded", "task")
    }
    fed |= {"encoded": encoded} | ({"task": np.full(len(x), 1)} if task is None else {})
    (q_step,) = session.run(["q_step"], fed)
    assert valid_A[q_step.argmax(axis=1)].all()
    assert np.isfinite(q_step).all()
    assert np.isfinite(0.0 * q_step + q_step).all(), "a readout that forgets everything stays a number"


def test_parity_sees_an_output_that_is_not_masked(monkeypatch: pytest.MonkeyPatch) -> None:
    agent, _ = wrong_actions_preferred()
    network, x = fold_agent(agent), observations(agent, 20)
    everything = replace(network, valid_actions_KA=np.ones_like(network.valid_actions_KA))
    unmasked_step = step_model(everything).SerializeToString()
    decision, names = decision_model(network).SerializeToString(), agent.suite.names
    masked = Exports(network, decision, step_model(network).SerializeToString(), {names[1]: nir_graph(network, 1)})
    assert [c.equal_actions for c in compare(agent, masked, 1, x)] == [20, 20]
    monkeypatch.setattr(nir_writer, "never_choosing_others", lambda network, task: network.head)
    unmasked = Exports(network, decision, unmasked_step, {names[1]: nir_graph(network, 1)})
    assert [c.equal_actions for c in compare(agent, unmasked, 1, x)] == [0, 0]


@pytest.mark.parametrize(
    "network",
    [MASKED, {"method": "DSQN", "normalization": "shared"}, {"method": "DQN"}, {"heads": "per_task"}],
    ids=["missing actions", "nothing depends on the task", "ANN", "heads per task"],
)
@pytest.mark.parametrize("task", [-1, -3, 3])
def test_a_task_that_does_not_exist_is_refused_by_onnx_files(network: dict[str, object], task: int) -> None:
    """ONNX itself counts negative indices from the end."""
    agent = make_agent(**network)
    folded, x = fold_agent(agent), observations(agent, 2)
    decision = decision_model(folded)
    session = onnx_session(decision.SerializeToString())
    fed = {"observation": x, "task": np.array([0, 2])}
    session.run(None, fed)
    fed["task"] = np.array([0, task])
    with pytest.raises(Exception, match=r"out of data bounds|out of bounds|idx=3"):
        session.run(None, fed)
    if folded.spiking:
        step = onnx_session(step_model(folded).SerializeToString())
        states = {v.name: np.zeros((2, *v.shape[1:]), np.float32) for v in step.get_inputs() if v.name != "task"}
        with pytest.raises(Exception, match=r"out of data bounds|out of bounds|idx=3"):
            step.run(None, states | {"task": np.array([0, task])})
    else:
        with pytest.raises(IndexError):
            onnx.reference.ReferenceEvaluator(decision).run(None, fed)
