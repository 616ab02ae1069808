"""Quantile regression: the loss by a naive loop, targets by hand, a random reward, and a whole run."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.learner import Learner, quantile_huber_loss, td_target
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import build_network
from tests.conftest import SameObservationEnvironment, small_config, vector_suite

SUITE = vector_suite(SameObservationEnvironment, 3)  # type: ignore[arg-type]


def quantile_config(quantiles: int = 5, **changes: object) -> ExperimentConfig:
    learning = {"loss": "huber", **changes.pop("learning", {})}  # type: ignore[dict-item]
    network = {"quantiles": quantiles, **changes.pop("network", {})}  # type: ignore[dict-item]
    return small_config(network=network, learning=learning, **changes)


def learner_of(config: ExperimentConfig) -> Learner:
    network = build_network(config.network, observation_spec(SUITE), 0)
    return Learner(network, config.learning, SUITE.valid_actions_KA, torch.device("cpu"), 0)


def naive_loss(values: list[list[float]], targets: list[list[float]]) -> float:
    """Dabney et al. 2018, Eq. 10, number by number."""
    total = 0.0
    for predicted, wanted in zip(values, targets, strict=True):
        for i, z in enumerate(predicted):
            tau = (2 * i + 1) / (2 * len(predicted))
            for y in wanted:
                error = y - z
                huber = 0.5 * error**2 if abs(error) <= 1.0 else abs(error) - 0.5
                total += abs(tau - (1.0 if error < 0 else 0.0)) * huber / len(wanted)
    return total / len(values)


@pytest.mark.parametrize(("quantiles", "targets"), [(1, 1), (2, 2), (7, 7), (4, 3)])
def test_the_loss_equals_a_naive_loop(quantiles: int, targets: int) -> None:
    """Values on both sides of the targets, within the quadratic part and outside."""
    generator = torch.Generator().manual_seed(quantiles)
    values, wanted = (3 * torch.randn(6, n, generator=generator, dtype=torch.float64) for n in (quantiles, targets))
    seen = quantile_huber_loss(values, wanted)
    assert float(seen) == pytest.approx(naive_loss(values.tolist(), wanted.tolist()), rel=1e-12)


def test_the_gradient_of_the_loss_is_that_of_finite_differences() -> None:
    generator = torch.Generator().manual_seed(1)
    values, wanted = (2 * torch.randn(4, 5, generator=generator, dtype=torch.float64) for _ in range(2))
    assert torch.autograd.gradcheck(lambda x: quantile_huber_loss(x, wanted), values.requires_grad_())


def test_the_target_has_every_quantile_of_the_action_with_the_largest_mean() -> None:
    next_values = torch.tensor([[[0.0, 5.0], [1.0, 6.0]], [[9.0, 0.0], [8.0, 0.0]], [[1.0, 2.0], [3.0, 4.0]]])
    target = td_target(
        rewards_B=torch.tensor([1.0, 2.0, 3.0]),
        terminated_B=torch.tensor([False, False, True]),
        next_values=next_values,
        q_choice_BA=next_values.mean(1),
        discounts_B=torch.tensor([0.5, 0.25, 0.5]),
    )
    assert target.tolist() == [[1 + 2.5, 1 + 3.0], [2 + 2.25, 2 + 2.0], [3.0, 3.0]]


@pytest.mark.parametrize("double_q", [True, False])
def test_an_update_is_that_of_the_formula(double_q: bool) -> None:
    """Loss and mean Q of the first update, from the networks' values: the action by the mean, of Q or of Q*."""
    learner = learner_of(quantile_config(learning={"double_q": double_q}))
    with torch.no_grad():
        for parameter in learner.target.parameters():
            parameter.mul_(-1.5)
    rng = np.random.default_rng(0)
    x = rng.normal(size=(2, 16, 3)).astype(np.float32)
    actions, terminated = rng.integers(0, 2, 16), rng.random(16) < 0.3
    rewards, discounts = rng.normal(size=16).astype(np.float32), np.full(16, 0.9, np.float32)
    with torch.no_grad():
        network, target = learner.network, learner.target
        inputs, following = (network.encode(torch.from_numpy(part)) for part in x)
        values_BMA = network.values(inputs, network.context(1), training=True).numpy()
        next_BMA = target.values(following, target.context(1), training=False).numpy()
        choice_BA = (network if double_q else target).decide(following, target.context(1), training=False).numpy()
    assert values_BMA.shape == (16, 5, 2)
    predicted = [values_BMA[b, :, actions[b]] for b in range(16)]
    wanted = [
        rewards[b] + 0.9 * (1 - terminated[b]) * next_BMA[b, :, choice_BA[b].argmax()].astype(float) for b in range(16)
    ]
    learner.update(Batch(x[0], actions, rewards, x[1], terminated, discounts), 1)
    means = learner.take_means()
    assert means["loss"] == pytest.approx(naive_loss([p.tolist() for p in predicted], [w.tolist() for w in wanted]))
    assert means["q"] == pytest.approx(float(np.mean(predicted)), rel=1e-5)


@pytest.mark.slow
def test_quantiles_of_a_random_reward_are_learned() -> None:
    """The reward is 10 with probability 1/4, else 0: one quantile in four is near 10, and their mean is near 2.5."""
    config = quantile_config(16, network={"method": "DQN", "hidden_units": 32}, learning={"learning_rate": 0.01})
    learner, rng = learner_of(config), np.random.default_rng(0)
    same = np.ones((64, 3), np.float32)
    for update in range(600):
        if update == 450:
            learner.optimizer.param_groups[0]["lr"] = 0.001
        rewards = np.where(rng.random(64) < 0.25, 10.0, 0.0).astype(np.float32)
        taken, ended = np.ones(64, np.int64), np.ones(64, np.bool_)
        learner.update(Batch(same, taken, rewards, same, ended, np.ones(64, np.float32)), 0)
    with torch.no_grad():
        network = learner.network.eval()
        values_M = network.values(network.encode(torch.ones(1, 3)), network.context(0))[0, :, 1]
        q = float(network(torch.ones(1, 3), 0)[0, 1])
    assert ((values_M[:12] - 0.0).abs() < 1.2).all(), values_M
    assert ((values_M[12:] - 10.0).abs() < 1.2).all(), values_M
    assert q == pytest.approx(float(values_M.mean()), rel=1e-5)
    assert q == pytest.approx(2.5, abs=0.4)


def test_settings_that_do_not_go_with_quantiles_are_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"learning\.loss is 'mse', expected huber with network\.quantiles=5$"):
        small_config(network={"quantiles": 5})
    with pytest.raises(
        ConfigError, match=r"network\.readout is 'max_membrane', expected mean or last_membrane with .*=5"
    ):
        quantile_config(network={"readout": "max_membrane"})
    with pytest.raises(ConfigError, match=r"network\.quantiles is 0, expected at least 1"):
        quantile_config(0)
    config = quantile_config()
    object.__setattr__(config.learning, "loss", "mse")  # as where the two sections were never checked together
    with pytest.raises(ConfigError, match=r"network\.quantiles=5, learning\.loss is 'mse', expected one of: huber"):
        learner_of(config)


@pytest.mark.slow
def test_a_run_with_quantiles_resumes_exactly_and_is_loaded_and_evaluated(tmp_path: Path) -> None:
    config = quantile_config(
        3, tasks={"suite": "minatar", "names": ["breakout", "asterix"]}, network={"trunk": "minatar"}
    )
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    train(config, whole)
    train(replace(config, total_steps=200), parts)
    train(config, parts)
    agents = [load_agent(path) for path in (whole, parts)]
    ours, theirs = (agent.network.state_dict() for agent in agents)
    assert all(torch.equal(ours[name], theirs[name]) for name in ours)
    assert ours["streams.advantage.head.weight"].shape == (3 * 6, 16)
    x = np.zeros((2, *agents[0].suite.observation_shape), agents[0].suite.frame_dtype)
    assert agents[0].q_values(x, "asterix").shape == (2, 6)
    assert evaluate(whole, episodes=1).score("asterix").episodes == 1
