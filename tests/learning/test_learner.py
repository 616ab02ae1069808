"""Eq. 2 by hand, the target network, masks."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch

from switchmt_snn.learning.learner import Learner, td_target
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.native import library as native_library
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import build_network
from tests.conftest import SameObservationEnvironment, small_config, vector_suite

builds = pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")


def test_double_q_target_by_hand() -> None:
    """y = r + gamma Q*(s', argmax_a Q(s', a)); y = r at a terminal state."""
    target = td_target(
        rewards_B=torch.tensor([1.0, 1.0, -0.5]),
        terminated_B=torch.tensor([False, True, False]),
        next_values=torch.tensor([[10.0, 20.0], [10.0, 20.0], [3.0, 4.0]]),
        q_choice_BA=torch.tensor([[5.0, 1.0], [5.0, 1.0], [0.0, 0.5]]),  # chooses 0, 0, 1
        discounts_B=torch.tensor([0.5, 0.5, 0.25]),
    )
    assert target.tolist() == [1.0 + 0.5 * 10.0, 1.0, -0.5 + 0.25 * 4.0]


def test_terminal_ignores_infinite_values() -> None:
    target = td_target(
        torch.tensor([1.0]),
        torch.tensor([True]),
        torch.tensor([[torch.inf]]),
        torch.tensor([[0.0]]),
        torch.tensor([0.99]),
    )
    assert target.tolist() == [1.0]


def learner(valid: list[list[bool]] | None = None, **learning: object) -> Learner:
    config = small_config(learning=dict(learning))
    suite = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]
    network = build_network(config.network, observation_spec(suite), 0)
    mask = np.asarray(valid) if valid else suite.valid_actions_KA
    return Learner(network, config.learning, mask, torch.device("cpu"), 0)


def batch(rewards: float = 1.0, n: int = 16) -> Batch:
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, n, 3)).astype(np.float32)
    return Batch(
        x[0],
        rng.integers(0, 2, n),
        np.full(n, rewards, np.float32),
        x[1],
        np.zeros(n, np.bool_),
        np.full(n, 0.99, np.float32),
    )


def test_target_moves_only_when_copied() -> None:
    part = learner()
    before = [p.clone() for p in part.target.parameters()]
    part.update(batch(), 0)
    assert all(torch.equal(a, b) for a, b in zip(before, part.target.parameters(), strict=True))
    assert not all(torch.equal(a, b) for a, b in zip(before, part.network.parameters(), strict=True))
    part.copy_target()
    for ours, target in zip(part.network.state_dict().values(), part.target.state_dict().values(), strict=True):
        assert torch.equal(ours, target)


def test_actions_that_do_not_exist_are_never_chosen() -> None:
    part = learner(valid=[[True, False], [False, True]])
    observations = np.random.default_rng(1).normal(size=(64, 3)).astype(np.float32)
    assert set(part.act(observations, 0)) == {0}
    assert set(part.act(observations, 1)) == {1}


def test_masked_target_equals_the_one_of_the_only_action() -> None:
    """With action 1 masked, targets are those of action 0 whatever the network says of action 1."""
    part = learner(valid=[[True, False], [True, True]], double_q=True)
    data = batch()
    with torch.no_grad():
        part.network.streams["advantage"].head.bias[1] += 1000.0
        part.target.load_state_dict(part.network.state_dict())
        q_next = part.target(torch.from_numpy(data.next_observations), 0)
    part.update(data, 0)
    q_online = q_next[:, 0]
    assert float(part.loss_sum) < float((1.0 + 0.99 * q_online.abs()).pow(2).max()) + 1e7
    assert part.act(data.observations, 0).max() == 0


@pytest.mark.parametrize("engine", ["eager", pytest.param("native", marks=builds)])
def test_the_learning_rate_falls_to_zero_over_updates_and_a_state_continues_it(engine: str) -> None:
    settings = {"engine": engine, "learning_rate": 0.004, "learning_rate_decay_updates": 4}
    part = learner(**settings)
    rates, moved = [], []
    for number in range(6):
        if number == 2:
            part, saved = learner(**settings), part.state_dict()
            part.load_state_dict(saved)
        before = part.parameters()
        part.update(batch(), 0)
        rates.append(part.optimizer.param_groups[0]["lr"])
        moved.append(float((part.parameters() - before).abs().max()))
    assert rates == pytest.approx([0.004, 0.003, 0.002, 0.001, 0.0, 0.0])
    assert moved[0] == pytest.approx(0.004, rel=1e-3)  # Adam's first step has the size of its rate
    assert moved[3] > 0.0
    assert moved[4] == moved[5] == 0.0


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["eager", pytest.param("native", marks=builds)])
def test_losses_and_clipping_change_the_update(engine: str) -> None:
    results = set()
    for settings in ({}, {"loss": "huber"}, {"gradient_clip": "value", "gradient_clip_at": 1e-3}, {"double_q": False}):
        part = learner(engine=engine, **settings)
        with torch.no_grad():  # online and target differ, so that double-Q matters
            for parameter in part.target.parameters():
                parameter.mul_(-1.5)
        for _ in range(3):
            part.update(batch(50.0), 0)
        results.add(part.parameters().numpy().tobytes())
    assert len(results) == 4


@builds
@pytest.mark.parametrize("precision", ["float32", "bfloat16"])
def test_native_updates_go_on_from_a_state_that_is_put_back(precision: str) -> None:
    """Nothing that was kept of weights, copies or the target outlives them."""
    part = learner(engine="native", precision=precision)
    part.update(batch(), 0)
    part.copy_target()
    state, after = copy.deepcopy(part.state_dict()), []
    for number in range(3):
        for task in (0, 1):
            part.update(batch(), task)
        after.append(part.parameters())
        if number == 1:
            part = learner(engine="native", precision=precision)
        part.load_state_dict(copy.deepcopy(state))
    assert torch.equal(after[0], after[1])
    assert torch.equal(after[0], after[2])
    assert not torch.equal(after[0], part.parameters())


def test_a_loss_that_is_not_finite_is_seen() -> None:
    part = learner()
    assert part.is_finite()
    part.update(batch(float("nan")), 0)
    assert not part.is_finite()


def test_bfloat16_rounds_the_products_of_an_update_and_nothing_else() -> None:
    """Gradients point the same way, weights and Adam's moments stay float32, acting is bitwise the same."""
    exact, rounded = learner(), learner(precision="bfloat16")
    observations = batch().observations
    assert np.array_equal(exact.act(observations, 0), rounded.act(observations, 0))
    gradients = []
    for one in (exact, rounded):
        one.update(batch(), 0)
        gradients.append(torch.cat([p.grad.reshape(-1) for p in one.network.parameters()]))
    assert not torch.equal(*gradients)
    assert torch.cosine_similarity(*gradients, dim=0) > 0.99
    assert {p.dtype for p in rounded.network.parameters()} == {torch.float32}
    assert {v.dtype for s in rounded.optimizer.state.values() for v in s.values()} == {torch.float32}
    x = torch.from_numpy(observations)
    rounded.network.load_state_dict(exact.network.state_dict())
    assert torch.equal(exact.network.eval()(x, 0), rounded.network.eval()(x, 0))
