"""What normalizes the next states of an update, and whose Q-values training acts by."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.learning.training import Training
from switchmt_snn.replay.ring import Returns
from switchmt_snn.updates import passes
from switchmt_snn.updates.engine import ENGINES
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly

builds = pytest.mark.skipif(not ENGINES["native"].status().startswith("works"), reason="no C++ compiler")
engines = pytest.mark.parametrize("engine", ["eager", pytest.param("native", marks=builds)])


def training(engine: str, **learning: Any) -> Training:
    config = small_config(
        network={"mlp_normalization": "batch", "stream_normalization": "batch"},
        learning={"engine": engine, "acting": engine, **learning},
    )
    return Training(config, vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4), torch.device("cpu"))


def played(engine: str, **learning: Any) -> Training:
    part = training(engine, **learning)
    for _ in part.events():
        pass
    return part


@pytest.mark.slow
@engines
@pytest.mark.parametrize("double_q", [True, False])
def test_next_states_are_normalized_by_the_batch_and_leave_no_trace(engine: str, double_q: bool) -> None:
    part = played(engine, next_statistics="batch", double_q=double_q)
    learner, batch = part.learner, part.replays[1].sample(16, np.random.default_rng(0), Returns())
    with torch.no_grad():  # so that Q and Q* differ
        for parameter in learner.network.parameters():
            parameter.mul_(1.1)
    network, target = copy.deepcopy(learner.network).train(), copy.deepcopy(learner.target).train()
    x, x_next = torch.from_numpy(batch.observations), torch.from_numpy(batch.next_observations)
    found = learner.engine.values(x, x_next, 1, torch.Generator())
    with torch.no_grad():
        torch.testing.assert_close(found.target, target(x_next, 1), rtol=1e-4, atol=1e-5)
        chooses = copy.deepcopy(network) if double_q else copy.deepcopy(learner.target).train()
        torch.testing.assert_close(found.choice_BA, chooses(x_next, 1), rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(found.online, network(x, 1), rtol=1e-4, atol=1e-5)
    for name, value in network.named_buffers():
        torch.testing.assert_close(learner.network.get_buffer(name), value, rtol=1e-4, atol=1e-6, msg=name)


@pytest.mark.slow
@engines
def test_the_target_s_statistics_do_not_move(engine: str) -> None:
    part = played(engine, next_statistics="batch")
    before = {name: value.clone() for name, value in part.learner.target.named_buffers()}
    part.learner.update(part.replays[0].sample(8, np.random.default_rng(0), Returns()), 0)
    assert any("running_mean" in name for name in before)
    for name, value in part.learner.target.named_buffers():
        assert torch.equal(value, before[name]), name


@pytest.mark.slow
@engines
@pytest.mark.parametrize("whose", ["online", "target"])
def test_training_acts_by_the_network_that_is_named(engine: str, whose: str) -> None:
    part = played(engine, acting_network=whose)
    learner, observations = part.learner, part.replays[1].sample(64, np.random.default_rng(0), Returns()).observations
    with torch.no_grad():
        for parameter in learner.network.parameters():
            parameter.copy_(torch.randn_like(parameter))
        networks = {"online": learner.network, "target": learner.target}
        q_BA = {name: net.eval()(torch.from_numpy(observations), 1) for name, net in networks.items()}
    greedy = {name: q.masked_fill(learner._invalid_KA[1], -torch.inf).argmax(1).numpy() for name, q in q_BA.items()}
    assert (greedy["online"] != greedy["target"]).any()
    assert (learner.act(observations, 1) == greedy[whose]).all()


@pytest.mark.slow
@engines
def test_a_run_with_both_continues_exactly(engine: str) -> None:
    assert_continues_exactly(
        lambda: training(engine, next_statistics="batch", acting_network="target"), at_steps=(61, 155)
    )


@pytest.mark.slow
@pytest.mark.parametrize(("double_q", "copies"), [(True, 2), (False, 1)])
def test_only_statistics_that_a_pass_moves_are_copied(
    double_q: bool, copies: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Q's are moved by the choice of the next action, which is Q's in double DQN alone."""
    copied: list[object] = []
    ours = passes._copied
    monkeypatch.setattr(passes, "_copied", lambda context: copied.append(context) or ours(context))
    part = played("eager", next_statistics="batch", double_q=double_q)
    copied.clear()
    part.learner.update(part.replays[0].sample(8, np.random.default_rng(0), Returns()), 0)
    assert len(copied) == copies
