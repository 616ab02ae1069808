"""The one-file SwitchMT as an oracle: written without the package, it must compute what the package computes."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from torch import Tensor

from examples import switchmt_in_one_file as one_file
from switchmt_snn.config import ExperimentConfig, NetworkConfig, SwitchingConfig, resolve
from switchmt_snn.learning.learner import Learner, td_target
from switchmt_snn.learning.switching import EpisodeRecord, SwitchingPolicy, SwitchTo
from switchmt_snn.replay.ring import Batch
from switchmt_snn.spiking.network import ObservationSpec, QNetwork, build_network
from tests.conftest import small_config

SHAPE, ACTIONS, TASKS, HIDDEN = (1, 6, 5), 3, 2, 32
NAMES = {
    "trunk.conv1.synapses": "convolution",
    "trunk.conv1.normalization": "normalization",
    "streams.value": "value",
    "streams.advantage": "advantage",
    "dendrites.segments_NSK": "segments_SK",
    "running_": "",
}
"""Names of our state dict -> the file's."""


def networks(seed: int) -> tuple[QNetwork, one_file.SpikingQNetwork]:
    """Ours and the file's with the same random weights, running statistics included."""
    config = NetworkConfig(method="SwitchMT", trunk="minatar", hidden_units=HIDDEN, dendrites="shared")
    observation = ObservationSpec(SHAPE, 1, 1 / 255, True, ACTIONS, TASKS)
    ours = build_network(resolve(ExperimentConfig(network=config)).network, observation, seed)
    generator = torch.Generator().manual_seed(seed)
    batch_norm = ours.trunk["conv1"].normalization
    with torch.no_grad():
        batch_norm.running_mean_KC.normal_(0, 0.1, generator=generator)
        batch_norm.running_var_KC.uniform_(0.02, 0.1, generator=generator)
        batch_norm.weight.uniform_(0.5, 1.5, generator=generator)
    theirs = one_file.SpikingQNetwork(SHAPE, ACTIONS, TASKS, HIDDEN, segments=3)
    state = {}
    for name, value in ours.state_dict().items():
        for old, new in NAMES.items():
            name = name.replace(old, new)
        state[name] = value[0] if name.endswith("segments_SK") else value
    known = theirs.state_dict()
    theirs.load_state_dict(known | {name: value.clone() for name, value in state.items() if name in known})
    return ours, theirs


def images(seed: int, n: int = 40) -> Tensor:
    generator = torch.Generator().manual_seed(seed)
    return torch.randint(0, 256, (n, *SHAPE), dtype=torch.uint8, generator=generator)


@pytest.mark.parametrize("task", range(TASKS))
@pytest.mark.parametrize("training", [False, True])
def test_network_gives_the_spikes_and_q_values_of_the_one_file_network(task: int, training: bool) -> None:
    ours, theirs = networks(seed=task)
    ours.train(training)
    theirs.train(training)
    activity: dict[str, Tensor] = {}
    spikes: dict[str, list[Tensor]] = {}
    q = ours(images(7), task, activity=activity)
    expected = theirs(images(7), task, spikes)
    for layer, name in (("conv1", "trunk"), ("value", "value"), ("advantage", "advantage")):
        assert torch.equal(activity[layer], torch.stack(spikes[name])), layer
        assert 0 < activity[layer].mean() < 1, "a layer that is silent or saturated proves nothing"
    torch.testing.assert_close(q, expected, rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(ours.trunk["conv1"].normalization.running_mean_KC, theirs.normalization.mean_KC)
    torch.testing.assert_close(ours.trunk["conv1"].normalization.running_var_KC, theirs.normalization.var_KC)


def test_td_target_equals_the_one_file_target() -> None:
    generator = torch.Generator().manual_seed(0)
    rewards = torch.randn(100, generator=generator)
    terminal = torch.rand(100, generator=generator) < 0.3
    q_star, q = torch.randn(2, 100, 5, generator=generator)
    assert torch.equal(
        td_target(rewards, terminal, q_star, q, torch.full_like(rewards, 0.9)),
        one_file.td_target(rewards, terminal, q_star, q, 0.9),
    )


def test_gradients_of_an_update_equal_the_one_file_gradients() -> None:
    ours, theirs = networks(seed=3)
    config = small_config(learning={"discount": 0.9, "batch_size": 40, "learning_starts_steps": 40}).learning
    learner = Learner(ours, config, np.ones((TASKS, ACTIONS), np.bool_), torch.device("cpu"), 0)
    target = copy.deepcopy(theirs).eval()
    rng = np.random.default_rng(0)
    actions, terminal = rng.integers(0, ACTIONS, 40), rng.random(40) < 0.3
    rewards = rng.choice([-1.0, 0.0, 1.0], 40).astype(np.float32)
    before, after = images(1).numpy(), images(2).numpy()
    learner.update(Batch(before, actions, rewards, after, terminal, np.full(40, 0.9, np.float32)), 1)
    parts = (before, actions, rewards, after, terminal)
    one_file.loss_on(tuple(torch.from_numpy(part) for part in parts), theirs, target, 1, discount=0.9).backward()
    gradients = {name: parameter.grad for name, parameter in theirs.named_parameters()}
    assert len(gradients) == len(list(ours.parameters())) > 5
    for name, parameter in ours.named_parameters():
        for old, new in NAMES.items():
            name = name.replace(old, new)
        expected = gradients[name]
        gradient = parameter.grad[0] if name.endswith("segments_SK") else parameter.grad
        torch.testing.assert_close(gradient, expected, rtol=1e-3, atol=1e-6, msg=name)


@pytest.mark.parametrize("seed", range(5))
def test_switching_decisions_equal_the_one_file_decisions(seed: int) -> None:
    """A random walk of parameters whose steps grow and shrink, so that both answers occur."""
    config = SwitchingConfig(policy="parameter_change", window_episodes=4, change_threshold=0.1)
    ours, theirs = SwitchingPolicy(config, TASKS), one_file.ParameterChange(window=4, threshold=0.1)
    generator = torch.Generator().manual_seed(seed)
    theta, task, episodes, left = torch.ones(50), 0, 0, 0
    for episode in range(300):
        episodes += 1
        size = 0.05 * (1.1 + np.sin(episode / 9))
        theta = theta + size * torch.randn(50, generator=generator)
        record = EpisodeRecord(task, episodes, episodes, episode, episode, 0.0, theta.clone)
        decision, leave = ours.end_of_episode(record), theirs.says_leave(theta)
        assert isinstance(decision, SwitchTo) == leave, f"episode {episode}"
        if leave:
            task, episodes, left = (task + 1) % TASKS, 0, left + 1
            theirs = one_file.ParameterChange(window=4, threshold=0.1)
    assert 5 < left < 60, "the walk must make the policy both stay and leave"


@pytest.mark.slow
def test_one_file_runs_from_the_command_line_arguments() -> None:
    scores = one_file.main(["--steps", "400", "--hidden", "8"])
    assert set(scores) == {"Catch", "Dodge"}
    assert all(-1.0 <= score <= 1.0 for score in scores.values())
