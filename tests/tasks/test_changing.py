"""Tasks that change midway: what is played before and after, and that a run continues exactly across the change."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch

from switchmt_snn import evaluate, load_agent, train
from switchmt_snn.acting.evaluation import EvaluationProtocol, evaluate_agent
from switchmt_snn.config import ExperimentConfig, TasksConfig, load_config
from switchmt_snn.errors import ConfigError, TaskError
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.plan import plan
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.registry import make_suite

SWAPPED = "switchmt_snn.tasks.swapped_cartpole:SwappedCartPole-v1"
CHANGE = 90
TASKS = TasksConfig(
    suite="gym",
    names=("CartPole-v1", "Acrobot-v1"),
    later_names=(SWAPPED, "Acrobot-v1"),
    later_from_steps=CHANGE,
    num_envs=2,
)


def small() -> ExperimentConfig:
    """A run that learns a little, with the change in the middle of a visit and of episodes."""
    base = load_config("classic")
    return replace(
        base,
        total_steps=160,
        tasks=TASKS,
        network=replace(base.network, hidden_units=8),
        learning=replace(
            base.learning,
            batch_size=8,
            learning_starts_steps=16,
            update_every_steps=16,
            updates_per_round=1,
            longest_random_action_steps=4,
        ),
        switching=replace(base.switching, visit_steps=40, max_stay_steps=40),
        evaluation=replace(
            base.evaluation, episodes=2, num_envs=2, max_episode_steps=40, every_steps=None, stop_at_returns=()
        ),
        recording=replace(base.recording, checkpoint_every_steps=1000),
    )


def played(play: Play, actions: list[int]) -> list[float]:
    """First observed value at each step of an episode."""
    play.begin(np.array([0]), np.array([7]))
    values = []
    for action in actions:
        play.step(np.array([action]))
        values.append(float(play.observations[0].flat[1]))
    return values


def test_a_task_is_the_later_one_from_the_step_on() -> None:
    suite = make_suite(TASKS)
    assert suite.names == ("CartPole-v1", "Acrobot-v1")
    assert suite.at(CHANGE - 1) is suite
    later = suite.at(CHANGE)
    assert later.names == suite.names
    assert suite.later is not None
    assert suite.later.changed == (0,)
    before, after = Play(suite, 0, 1), Play(later, 0, 1)
    right, left = played(before, [1, 1, 1]), played(before, [0, 0, 0])
    assert right != left
    assert played(after, [1, 1, 1]) == left
    assert played(after, [0, 0, 0]) == right


def state_at_end(training: Training) -> dict[str, torch.Tensor]:
    return {name: tensor.clone() for name, tensor in training.learner.network.state_dict().items()}


def test_episodes_of_the_task_that_changes_are_cut_off_and_others_go_on() -> None:
    planned = plan(small())
    training = Training(planned.config, planned.suite, planned.device)
    lengths: dict[int, list[int]] = {}
    for event in training.events():
        if type(event).__name__ == "Stepped":
            lengths[training.steps] = [int(n) for n in training._play(training.task).lengths_steps]
            suites = {task: play.suite.at(0) is planned.suite for task, play in training._plays.items()}
            if training.steps >= CHANGE:
                assert suites.get(0, False) is False
                assert suites[1] is True
    assert training.steps == 160
    # the change falls into the third visit, that of the first task: both copies begin anew there
    assert training.steps_by_task == [80, 80]
    assert lengths[CHANGE] == [0, 0]
    assert lengths[CHANGE - 2] != [0, 0]


@pytest.mark.parametrize("stop_at", [CHANGE - 2, CHANGE, CHANGE + 2, 124])
def test_a_run_continues_exactly_across_the_change(stop_at: int) -> None:
    planned = plan(small())
    whole = Training(planned.config, planned.suite, planned.device)
    parts = Training(planned.config, planned.suite, planned.device)
    for _ in whole.events():
        pass
    for event in parts.events():
        if type(event).__name__ == "Stepped" and parts.steps == stop_at:
            break
    state, replays = parts.state_dict(), parts.replays
    resumed = Training(planned.config, planned.suite, planned.device)
    resumed.load_state_dict(state)
    resumed.replays = replays
    assert resumed.reproducible
    for _ in resumed.events():
        pass
    ends = state_at_end(whole), state_at_end(resumed)
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])
    assert whole.explore_rng.bit_generator.state == resumed.explore_rng.bit_generator.state
    assert whole.starts_by_task == resumed.starts_by_task


def test_what_is_evaluated_is_the_task_as_it_is_at_the_weights_step(tmp_path: Path) -> None:
    run = tmp_path / "run"
    train(small(), run=run)
    agent = load_agent(run)
    assert agent.suite.names == ("CartPole-v1", "Acrobot-v1")
    own = evaluate(run, save=False, episodes=2)
    swapped = replace(TASKS, names=(SWAPPED, "Acrobot-v1"), later_names=(), later_from_steps=None)
    agent.suite = replace(make_suite(swapped), names=agent.suite.names)
    other = evaluate_agent(agent, EvaluationProtocol.of(replace(small().evaluation, episodes=2), small().tasks))
    assert [row.mean for row in own.tasks] == [row.mean for row in other.tasks]
    assert str(own.protocol).endswith(f", CartPole-v1 played as {SWAPPED}")
    assert EvaluationProtocol.of(small().evaluation, TASKS, CHANGE - 1).environment == ()
    with (run / "episodes.csv").open() as file:
        assert {row["task"] for row in csv.DictReader(file)} <= {"CartPole-v1", "Acrobot-v1"}


@pytest.mark.parametrize(
    ("change", "line"),
    [
        ({"later_names": (SWAPPED,)}, "tasks.later_names is .*, expected one name for each of tasks.names"),
        ({"later_names": ("CartPole-v1", "Acrobot-v1")}, "expected another name for one task at least"),
        ({"later_from_steps": None}, "tasks.later_from_steps is None, expected the step"),
        ({"later_names": ()}, "tasks.later_from_steps is 90, expected null"),
        ({"later_from_steps": 0}, "expected at least 1"),
    ],
)
def test_a_change_that_is_half_stated_is_one_line(change: dict[str, object], line: str) -> None:
    with pytest.raises(ConfigError, match=line):
        replace(TASKS, **change)  # type: ignore[arg-type]


def test_a_later_task_has_the_same_actions() -> None:
    with pytest.raises(TaskError, match="makes 'Acrobot-v1' of 'CartPole-v1', expected a task with the same actions"):
        make_suite(replace(TASKS, later_names=("Acrobot-v1", "Acrobot-v1")))


def test_random_play_finds_the_goal_of_the_held_mountain_car_only() -> None:
    reached = {}
    for name in ("MountainCar-v0", "switchmt_snn.tasks.held_mountain_car:HeldMountainCar-v0"):
        env, rng, goals = gymnasium.make(name), np.random.default_rng(0), 0
        for seed in range(300):
            env.reset(seed=seed)
            terminated = truncated = False
            while not (terminated or truncated):
                _, _, terminated, truncated, _ = env.step(int(rng.integers(3)))
            goals += terminated
        reached[name.rsplit(":", 1)[-1]] = goals
    assert reached == {"MountainCar-v0": 0, "HeldMountainCar-v0": 3}


def test_a_held_action_is_eight_steps_of_mountain_car() -> None:
    held = gymnasium.make("switchmt_snn.tasks.held_mountain_car:HeldMountainCar-v0")
    plain = gymnasium.make("MountainCar-v0")
    held.reset(seed=3)
    plain.reset(seed=3)
    rng, steps, over, total = np.random.default_rng(0), 0, False, 0.0
    while not over:
        action = int(rng.integers(3))
        observation, reward, terminated, truncated, _ = held.step(action)
        for _ in range(8):
            expected, one, *ended, _ = plain.step(action)
        assert observation.tolist() == expected.tolist()
        assert (float(reward), [terminated, truncated]) == (8 * float(one), ended)
        steps, over, total = steps + 1, terminated or truncated, total + float(reward)
    assert (steps, total) == (25, -200.0)
