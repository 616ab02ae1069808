"""Tasks: Atari against gymnasium's single environment, episodes as functions of seed and actions, padding, masks."""

from __future__ import annotations

import ale_py
import gymnasium
import numpy as np
import pytest
from ale_py.vector_env import AtariVectorEnv
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation

from switchmt_snn.config import TasksConfig
from switchmt_snn.errors import ConfigError, TaskError
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.registry import make_suite, suite_of
from tests.conftest import CountingEnvironment, vector_suite

gymnasium.register_envs(ale_py)


@pytest.mark.slow
@pytest.mark.parametrize(("game", "name"), [("pong", "Pong"), ("breakout", "Breakout"), ("enduro", "Enduro")])
def test_atari_equals_gymnasium_with_the_standard_wrappers(game: str, name: str) -> None:
    """Same actions: equal stacks, rewards, terminations and lost lives, episode for episode.

    Without no-ops and FIRE, whose random numbers the two draw differently.
    """
    config = TasksConfig(names=(game,), noop_max=0, fire_on_reset=False)
    play = Play(make_suite(config), 0, 1)
    single = gymnasium.make(f"{name}NoFrameskip-v4", full_action_space=True, repeat_action_probability=0.0)
    single = FrameStackObservation(AtariPreprocessing(single, noop_max=0), 4, padding_type="zero")
    play.begin(np.asarray([0]), np.asarray([3]))
    expected, _ = single.reset(seed=3)
    rng, rewards, ended, lost, lives = np.random.default_rng(1), 0, 0, 0, single.unwrapped.ale.lives()
    for _ in range(700):
        assert np.array_equal(play.observations[0], expected)
        action = int(rng.integers(18))
        played = play.step(np.asarray([action]))
        expected, reward, terminated, truncated, _ = single.step(action)
        assert played.rewards[0] == reward
        assert (played.terminated[0], played.truncated[0]) == (terminated, truncated)
        fallen, lives = single.unwrapped.ale.lives() < lives, single.unwrapped.ale.lives()
        assert played.lives_lost is not None
        assert played.lives_lost[0] == fallen
        lost += fallen
        rewards += reward != 0
        if terminated or truncated:
            ended += 1
            play.begin(np.asarray([0]), np.asarray([3]))
            expected, _ = single.reset(seed=3)
            lives = single.unwrapped.ale.lives()
    assert lost == (5 * ended + 5 - lives if game == "breakout" else 0)
    assert rewards or game == "enduro"
    assert ended or game != "breakout"
    play.close()
    single.close()


@pytest.mark.slow
def test_stacks_equal_the_vector_environments_own() -> None:
    """With no-ops, FIRE and sticky actions: our stacking of single frames equals AtariVectorEnv's stacking."""
    config = TasksConfig(names=("breakout",), sticky_action_probability=0.25, num_envs=2)
    play = Play(make_suite(config), 0, 2)
    theirs = AtariVectorEnv(
        "breakout", 2, repeat_action_probability=0.25, full_action_space=True, reward_clipping=False, stack_num=4
    )
    seeds = np.asarray([11, 5])
    play.begin(np.arange(2), seeds)
    expected, _ = theirs.reset(seed=seeds)
    rng = np.random.default_rng(0)
    for _ in range(100):
        assert np.array_equal(play.observations, expected)
        actions = rng.integers(0, 18, 2)
        play.step(actions)
        expected, *_ = theirs.step(actions)
    play.close()
    theirs.close()


SUITES = {
    "atari": TasksConfig(names=("breakout", "pong"), sticky_action_probability=0.25),
    "minatar": TasksConfig(suite="minatar", names=("space_invaders", "breakout"), sticky_action_probability=0.1),
    "gym": TasksConfig(suite="gym", names=("CartPole-v1", "Acrobot-v1")),
}


@pytest.mark.slow
@pytest.mark.parametrize("suite_name", SUITES)
def test_an_episode_is_a_function_of_seed_and_actions(suite_name: str) -> None:
    """A restored play has the same observations as the one that went on, and goes on the same."""
    suite = make_suite(SUITES[suite_name])
    for task in range(2):
        rng = np.random.default_rng(task)
        one = Play(suite, task, 3)
        starts = 0

        def begin(play: Play, envs: np.ndarray, first: int) -> None:
            play.begin(envs, np.asarray([episode_seed(1, play.task, first + i) for i in range(len(envs))]))

        begin(one, np.arange(3), 0)
        starts = 3
        journal = []
        for step in range(240):
            if step == 150:
                saved = one.state_dict()
            if step >= 150:
                journal.append((one.observations.copy(), one.returns.copy()))
            actions = np.flatnonzero(suite.valid_actions_KA[task])[
                rng.integers(0, suite.valid_actions_KA[task].sum(), 3)
            ]
            ended = one.step(actions).ended
            if step >= 150:
                journal[-1] += (actions, ended, starts)
            if len(ended):
                begin(one, ended, starts)
                starts += len(ended)
        two = Play(suite, task, 3)
        assert two.load_state_dict(saved)
        for observations, returns, actions, ended, first in journal:
            assert np.array_equal(two.observations, observations)
            assert np.array_equal(two.returns, returns)
            assert np.array_equal(two.step(actions).ended, ended)
            if len(ended):
                begin(two, ended, first)
        one.close()
        two.close()


@pytest.mark.slow
def test_truncation_is_told_apart() -> None:
    suite = make_suite(TasksConfig(names=("pong",), max_episode_frames=40))
    play = Play(suite, 0, 1)
    play.begin(np.asarray([0]), np.asarray([0]))
    for _ in range(40):
        played = play.step(np.asarray([0]))
        if len(played.ended):
            break
    assert played.truncated[0]
    assert not played.terminated[0]
    play.close()


def test_gym_tasks_are_padded_and_masked() -> None:
    suite = make_suite(SUITES["gym"])
    assert suite.frame_shape == (6,)
    assert suite.num_actions == 3
    assert suite.valid_actions_KA.tolist() == [[True, True, False], [True, True, True]]
    play = Play(suite, 0, 1)
    play.begin(np.asarray([0]), np.asarray([0]))
    assert (play.observations[0, 4:] == 0).all()
    assert (play.observations[0, :4] != 0).any()
    play.close()


def test_minatar_channels_are_padded() -> None:
    suite = make_suite(SUITES["minatar"])
    assert suite.frame_shape == (6, 10, 10)
    assert suite.num_actions == 6
    play = Play(suite, 1, 1)
    frame = play.begin(np.asarray([0]), np.asarray([0]))
    assert (frame[0, 4:] == 0).all()
    assert set(np.unique(frame)) == {0, 1}
    play.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("config", "message"),
    [
        (TasksConfig(names=("pongg",)), "unknown atari task 'pongg'; did you mean 'pong'"),
        (TasksConfig(names=("CartPole-v1",)), r"expected one of that suite; tasks\.suite=gym has it"),
        (TasksConfig(names=("asterix", "my_envs:Left-v0")), r"'my_envs:Left-v0', .*; tasks\.suite=gym has it"),
        (TasksConfig(suite="minatar", names=("pong",)), r"tasks\.suite=atari has it"),
        (TasksConfig(suite="minatar", names=("brekout",)), "did you mean 'breakout'"),
        (TasksConfig(suite="gym", names=("CartPole-v9",)), "unknown Gymnasium id 'CartPole-v9'"),
        (TasksConfig(suite="gym", names=("Nothing-v0",)), "unknown Gymnasium id"),
        (TasksConfig(suite="gym", names=("Pendulum-v1",)), "expected Discrete"),
        (TasksConfig(suite="gym", names=("FrozenLake-v1",)), "expected a Box"),
        (TasksConfig(names=("pong", "enduro"), full_action_space=False), "minimal action sets differ"),
    ],
)
def test_wrong_tasks_are_named(config: TasksConfig, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        make_suite(config)


def test_an_environment_that_does_not_repeat_itself_is_noticed() -> None:
    calls = []

    class Forgetful(CountingEnvironment):
        def reset(self, env_ids, seeds):  # type: ignore[no-untyped-def]
            calls.append(1)
            return super().reset(env_ids, seeds + len(calls))

    suite = vector_suite(lambda task, n: Forgetful(task, n, 50), 4)
    play = Play(suite, 0, 1)
    play.begin(np.asarray([0]), np.asarray([1]))
    play.step(np.asarray([0]))
    assert not Play(suite, 0, 1).load_state_dict(play.state_dict())


@pytest.mark.slow
def test_the_minimal_action_mask_keeps_all_outputs_and_their_meaning() -> None:
    suite = make_suite(TasksConfig(minimal_action_mask=True))
    assert suite.num_actions == 18
    assert suite.action_names == make_suite(TasksConfig()).action_names
    valid = {
        name: [suite.action_names[a] for a in np.flatnonzero(suite.valid_actions_KA[k])]
        for k, name in enumerate(suite.names)
    }
    assert valid["pong"] == ["NOOP", "FIRE", "RIGHT", "LEFT", "RIGHTFIRE", "LEFTFIRE"]
    assert valid["breakout"] == ["NOOP", "FIRE", "RIGHT", "LEFT"]
    assert len(valid["enduro"]) == 9
    minatar = make_suite(TasksConfig(suite="minatar", names=("breakout", "freeway"), minimal_action_mask=True))
    assert [np.flatnonzero(row).tolist() for row in minatar.valid_actions_KA] == [[0, 1, 3], [0, 2, 4]]


@pytest.mark.parametrize("suite_name", ["atari", "minatar"])
def test_the_protocol_says_which_actions_a_score_had(suite_name: str) -> None:
    names = ("breakout",)
    (masked, *_), (full, *_) = (
        suite_of(TasksConfig(suite=suite_name, names=names, minimal_action_mask=mask)).protocol
        for mask in (True, False)
    )
    assert masked == "minimal actions"
    assert full in ("all 18 actions", "all 6 actions")


def test_a_mask_that_would_hide_nothing_is_refused_by_name() -> None:
    with pytest.raises(
        ConfigError, match=r"tasks\.minimal_action_mask is True, expected false with .*full_action_space"
    ):
        TasksConfig(minimal_action_mask=True, full_action_space=False)
    with pytest.raises(ConfigError, match=r"tasks\.minimal_action_mask is True, expected false for the suite 'gym'"):
        make_suite(TasksConfig(suite="gym", names=("CartPole-v1",), minimal_action_mask=True))
