"""A loop of one's own sees what training and evaluation see."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import EvaluationProtocol, evaluate_agent
from switchmt_snn.config import EvaluationConfig, TasksConfig
from switchmt_snn.errors import TaskError
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.as_trained import TaskAsTrained
from switchmt_snn.tasks.play import episode_seed
from switchmt_snn.tasks.registry import make_suite
from tests.conftest import CountingEnvironment, small_config, vector_suite


def agent_of(suite: str, *names: str, **tasks: object) -> Agent:
    trunk = {"atari": "nature", "minatar": "minatar", "gym": "mlp"}[suite]
    config = small_config(
        tasks={"suite": suite, "names": list(names), **tasks}, network={"trunk": trunk, "threshold": 0.1}
    )
    made = make_suite(config.tasks)
    return Agent(build_network(config.network, observation_spec(made), 3), made, config, torch.device("cpu"), 12)


GAMES = [
    pytest.param("minatar", ("breakout", "asterix"), {"sticky_action_probability": 0.1}, 300, id="minatar"),
    pytest.param("gym", ("CartPole-v1", "Acrobot-v1"), {}, 300, id="gym"),
    pytest.param("atari", ("pong", "breakout"), {}, 200, id="atari", marks=pytest.mark.slow),
]


@pytest.mark.slow
@pytest.mark.parametrize(("suite", "names", "tasks", "longest"), GAMES)
def test_an_own_loop_plays_the_episodes_of_an_evaluation(
    suite: str, names: tuple[str, ...], tasks: dict[str, object], longest: int
) -> None:
    """Same seed, same greedy actions: same return and same length as ``evaluate`` reports, in every task."""
    agent = agent_of(suite, *names, **tasks)
    config = EvaluationConfig(episodes=2, num_envs=2, epsilon=0.0, max_episode_steps=longest)
    scores = evaluate_agent(agent, EvaluationProtocol.of(config, agent.config.tasks)).episodes
    played = []
    for index, name in enumerate(names):
        env = TaskAsTrained(agent.suite, name)
        for episode in range(2):
            observation, _ = env.reset(seed=episode_seed(config.seed, index, episode))
            score, length, over = 0.0, 0, False
            while not over and length < longest:
                assert env.observation_space.contains(observation)
                observation, reward, terminated, truncated, _ = env.step(agent.act(observation, name))
                score, length, over = score + reward, length + 1, terminated or truncated
            played.append((name, episode, score, length))
        env.close()
    assert played == [(e.task, e.episode, e.score, e.length_steps) for e in scores if e.policy == "agent"]
    assert len(played) == 2 * len(names)


@pytest.mark.filterwarnings("ignore")
def test_it_is_an_environment_of_gymnasium() -> None:
    suite = make_suite(TasksConfig(suite="minatar", names=("breakout",)))
    check_env(TaskAsTrained(suite, "breakout"), skip_render_check=True)


def test_frames_are_stacked_and_an_episode_is_its_seed() -> None:
    env = TaskAsTrained(vector_suite(lambda task, n: CountingEnvironment(task, n, 5), 4, stack=2), "b")
    first, _ = env.reset(seed=8)
    assert first.tolist() == [0, 0, 0, 0, 1, 0, 8, 0]  # nothing before the start; task 1, copy 0, seed 8, step 0
    assert env.step(0)[0].tolist() == [1, 0, 8, 0, 1, 0, 8, 1]
    env.reset(seed=3)
    drawn = [env.reset()[0].tolist() for _ in range(2)]
    env.reset(seed=3)
    assert drawn == [env.reset()[0].tolist() for _ in range(2)]
    assert drawn[0] != drawn[1]


def test_wrong_use_is_one_line() -> None:
    agent = agent_of("gym", "CartPole-v1", "Acrobot-v1")
    with pytest.raises(TaskError, match="unknown task 'CartPole'"):
        TaskAsTrained(agent.suite, "CartPole")
    env = TaskAsTrained(agent.suite, "CartPole-v1")
    with pytest.raises(TaskError, match=r"no episode of task 'CartPole-v1' runs, expected reset\(\) before this step"):
        env.step(0)
    env.reset(seed=0)
    with pytest.raises(TaskError, match=r"the action is 2, expected one of task 'CartPole-v1': \[0, 1\]"):
        env.step(2)
    mask = env.reset(seed=0)[1]["action_mask"]
    assert {int(env.action_space.sample(mask)) for _ in range(40)} == {0, 1}
    assert env.step(1)[4]["action_mask"].tolist() == [1, 1, 0]
    env.reset(seed=0)
    while not any(env.step(1)[2:4]):
        pass
    with pytest.raises(TaskError, match="expected reset"):
        env.step(0)


def test_it_can_be_wrapped() -> None:
    suite = make_suite(TasksConfig(suite="gym", names=("CartPole-v1",)))
    env = gymnasium.wrappers.RecordEpisodeStatistics(TaskAsTrained(suite, 0))
    env.reset(seed=1)
    over, steps = False, 0
    while not over:
        _, _, terminated, truncated, info = env.step(steps % 2)
        over, steps = terminated or truncated, steps + 1
    assert float(np.asarray(info["episode"]["r"]).item()) == steps
