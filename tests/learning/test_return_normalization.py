"""Return normalization: the scale itself, what it divides, and that everything else stays in the task's rewards."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from switchmt_snn.config import LearningConfig
from switchmt_snn.errors import ConfigError
from switchmt_snn.learning.learner import Learner
from switchmt_snn.learning.return_scale import ReturnScale
from switchmt_snn.learning.training import Training
from switchmt_snn.updates.engine import ENGINES
from tests.conftest import CountingEnvironment, small_config, vector_suite
from tests.learning.resuming import assert_continues_exactly
from tests.learning.test_learner import batch, learner

builds = pytest.mark.skipif(not ENGINES["native"].status().startswith("works"), reason="no C++ compiler")
STEPS = st.lists(
    st.tuples(st.lists(st.floats(-5, 5), min_size=2, max_size=2), st.lists(st.booleans(), min_size=2, max_size=2)),
    min_size=1,
    max_size=30,
)


def training(engine: str = "eager", copies: int = 1, **learning: Any) -> Training:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 7), 4)
    config = small_config(
        tasks={"num_envs": copies},
        learning={
            "return_normalization": "per_task",
            "clip_rewards": False,
            "engine": engine,
            "acting": engine,
            **learning,
        },
    )
    return Training(config, suite, torch.device("cpu"))


def played(**settings: Any) -> Training:
    part = training(**settings)
    for _ in part.events():
        pass
    return part


@pytest.mark.slow
@given(steps=STEPS, discount=st.sampled_from([0.0, 0.9, 1.0]), clip=st.booleans())
def test_the_scale_is_the_root_mean_square_of_the_returns_so_far(steps: Any, discount: float, clip: bool) -> None:
    scale = ReturnScale(2, discount, clip)
    naive: list[float] = []
    for copy in range(2):
        episode: list[float] = []
        for rewards, over in steps:
            episode.append(max(-1.0, min(1.0, rewards[copy])) if clip else rewards[copy])
            naive.append(sum(reward * discount**age for age, reward in enumerate(reversed(episode))))
            episode = [] if over[copy] else episode
    for rewards, over in steps:
        scale.add(np.asarray(rewards), np.asarray(over))
    expected = math.sqrt(sum(value**2 for value in naive) / len(naive))
    assert scale.value == pytest.approx(expected if expected > 0.0 else 1.0)


def test_without_a_reward_the_scale_is_one() -> None:
    scale = ReturnScale(1, 0.99, False)
    assert scale.value == 1.0
    scale.add(np.zeros(1), np.zeros(1, np.bool_))
    assert scale.value == 1.0
    scale.add(np.asarray([-2.0]), np.zeros(1, np.bool_))
    assert scale.value == pytest.approx(math.sqrt(2.0))


@pytest.mark.parametrize("loss", ["mse", "huber"])
def test_a_learner_divides_the_td_errors_of_one_task(loss: str) -> None:
    """The loss of errors of about 30 in units of 4; Q stays what the network says."""
    plain, scaled = learner(loss=loss), learner(loss=loss)
    scaled.set_scale(1, 4.0)
    means: dict[str, dict[int, dict[str, float]]] = {"plain": {}, "scaled": {}}
    for task in (0, 1):
        for name, part in (("plain", plain), ("scaled", scaled)):
            part.update(batch(rewards=30.0), task)
            means[name][task] = part.take_means()
            if task == 0:
                assert torch.equal(part.parameters(), plain.parameters())
    assert means["scaled"][0] == means["plain"][0]
    assert means["scaled"][1]["q"] == means["plain"][1]["q"]
    ratio = means["plain"][1]["loss"] / means["scaled"][1]["loss"]
    assert ratio == pytest.approx(16.0) if loss == "mse" else 4.0 < ratio < 4.5


def test_a_scale_divides_the_gradient_of_huge_errors() -> None:
    gradients: list[float] = []
    for scale in (1.0, 10.0):
        part: Learner = learner(loss="huber")
        part.set_scale(0, scale)
        part.update(batch(rewards=1000.0), 0)
        squares = [float(p.grad.square().sum()) for p in part.network.parameters() if p.grad is not None]
        gradients.append(math.sqrt(sum(squares)))
    assert gradients[0] == pytest.approx(10.0 * gradients[1], rel=1e-4)


@pytest.mark.slow
def test_each_task_has_the_scale_of_its_own_returns() -> None:
    """Rewards are 1 to 7 within an episode; without a discount they are the returns."""
    part = played(discount=0.0)
    expected = math.sqrt(sum(reward**2 for reward in range(1, 8)) / 7)
    assert [scale.count for scale in part.return_scales] == part.steps_by_task
    for task, scale in enumerate(part.return_scales):
        assert scale.value == pytest.approx(expected, rel=0.05)
        assert part.learner._scale_K[task].item() == pytest.approx(expected, rel=0.05)


@pytest.mark.slow
def test_clipped_rewards_have_the_scale_of_clipped_rewards() -> None:
    assert [scale.value for scale in played(discount=0.0, clip_rewards=True).return_scales] == [1.0, 1.0]


@pytest.mark.slow
def test_a_truncated_return_ends_with_its_episode() -> None:
    """Half of the episodes are truncated: 7 steps of 1 to 7 whatever ends them."""
    part = played(discount=1.0, copies=4)
    sums = [sum(range(1, step + 1)) for step in range(1, 8)]
    assert len(part.return_scales) == 2
    for scale in part.return_scales:
        assert scale.value == pytest.approx(math.sqrt(sum(value**2 for value in sums) / 7), rel=0.05)


@pytest.mark.slow
def test_without_the_setting_errors_are_divided_by_one() -> None:
    part = played(return_normalization="none")
    assert part.return_scales == []
    assert part.learner._scale_K.tolist() == [1.0, 1.0]


def test_a_state_from_before_the_setting_continues() -> None:
    part = training(return_normalization="none")
    state = part.state_dict()
    del state["return_scales"]
    part.load_state_dict(state)
    assert part.return_scales == []


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["eager", pytest.param("native", marks=builds)])
@pytest.mark.parametrize("overlap", [False, True])
def test_a_normalized_run_continues_exactly(engine: str, overlap: bool) -> None:
    settings = {"overlap": overlap, "update_tasks": "all", "update_every_steps": 4, "updates_per_round": 2}
    whole = assert_continues_exactly(lambda: training(engine, 2, **settings), at_steps=(4, 130, 302))
    assert all(scale.value > 1.0 for scale in whole.return_scales)


def test_an_unknown_return_normalization_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match=r"learning\.return_normalization"):
        LearningConfig(return_normalization="shared")  # type: ignore[arg-type]
