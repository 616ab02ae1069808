"""Evaluation: the protocol's episodes, determinism, and numbers by hand."""

from __future__ import annotations

import json
import math
import pickle  # noqa: TID251 - what users' process pools do
import threading
from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.episodes import EpisodeScore, Playing, play_episodes
from switchmt_snn.acting.evaluation import (
    DecisionMaker,
    EvaluationProtocol,
    EvaluationStopped,
    evaluate_agent,
    summarize,
)
from switchmt_snn.config import EvaluationConfig, TasksConfig
from switchmt_snn.config.suites import SUITE_DEFAULTS
from switchmt_snn.errors import TaskError
from switchmt_snn.export.folded import fold_agent, metadata
from switchmt_snn.export.formats.files import nir_graphs
from switchmt_snn.export.formats.onnx_writer import decision_model
from switchmt_snn.export.runtimes.agents import NirAgent, OnnxAgent
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.machine.cores import Parts, parts
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.atari import AtariSuite
from switchmt_snn.tasks.gym_make import make_environment
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import Reference, TaskSuite
from switchmt_snn.viewing.tables import published_rows
from tests.conftest import CountingEnvironment, small_config, vector_suite

PROTOCOL = EvaluationProtocol.of(EvaluationConfig(episodes=7, num_envs=3), TasksConfig(suite="minatar"))


def minatar_agent(**network: str) -> Agent:
    config = small_config(
        tasks={"suite": "minatar", "names": ["breakout", "asterix"], "sticky_action_probability": 0.1},
        network={"trunk": "minatar", "threshold": 0.3, **network},
    )
    suite = make_suite(config.tasks)
    return Agent(build_network(config.network, observation_spec(suite), 3), suite, config, torch.device("cpu"), 12)


def small_agent(suite: TaskSuite) -> Agent:
    config = small_config()
    return Agent(build_network(config.network, observation_spec(suite), 3), suite, config, torch.device("cpu"), 12)


def test_every_episode_is_played_once_with_its_own_seed() -> None:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 9), 4)
    scores = play_episodes(
        "agent", lambda x, task: np.tile([[0.0, 2.0]], (len(x), 1)), suite, 1, range(7), Playing(10_000, 0.0)
    )
    assert [score.episode for score in scores] == list(range(7))
    assert len({score.seed for score in scores}) == 7
    assert all(score.score == 45 and score.length_steps == 9 and score.mean_q == 2.0 for score in scores)
    assert {score.truncated for score in scores} == {score.seed % 2 == 0 for score in scores}


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["torch", "onnx", "nir"])
def test_an_episode_of_a_random_encoding_does_not_depend_on_how_many_are_played_at_once(kind: str) -> None:
    """Grey pixels, so that what is drawn matters; the third episode used to change with num_envs."""
    agent = minatar_agent(encoding="rate")
    agent.suite = replace(agent.suite, scale=0.5)
    agent.network.observation = replace(agent.network.observation, scale=0.5)
    played: DecisionMaker = agent
    network = fold_agent(agent)
    if kind == "onnx":
        played = OnnxAgent(decision_model(network).SerializeToString(), agent.suite, agent.config)
    elif kind == "nir":
        played = NirAgent(nir_graphs(network), agent.suite, agent.config)
    assert played.draws
    protocol = replace(PROTOCOL, episodes=4)

    def scores(**changes: int) -> list[tuple[float, int]]:
        return [(e.score, e.length_steps) for e in evaluate_agent(played, replace(protocol, **changes)).episodes]

    assert scores(num_envs=1) == scores(num_envs=3) == scores(num_envs=4)
    assert scores(seed=1) != scores()


@pytest.mark.slow
def test_deterministic_for_a_seed() -> None:
    one, two = (evaluate_agent(minatar_agent(), PROTOCOL) for _ in range(2))
    assert one == two
    other = evaluate_agent(minatar_agent(), replace(PROTOCOL, seed=1))
    assert [e.score for e in other.episodes] != [e.score for e in one.episodes]


@pytest.mark.slow
@pytest.mark.parametrize(("encoding", "engine"), [("direct", "fused"), ("rate", "fused"), ("direct", "snntorch")])
def test_threads_play_what_one_after_the_other_plays(encoding: str, engine: str) -> None:
    """snnTorch's neurons write into themselves and random encodings draw: neither is shared between threads."""

    agent = minatar_agent(encoding=encoding, neuron_engine=engine)
    threads = evaluate_agent(agent, PROTOCOL)
    agent.suite = replace(agent.suite, thread_safe=False)
    assert evaluate_agent(agent, PROTOCOL) == threads


@pytest.mark.slow
def test_scores_do_not_depend_on_how_many_play_side_by_side() -> None:
    """The random policy exactly: an episode is its seed's alone."""
    agent = minatar_agent()
    by_width = [
        [e for e in evaluate_agent(agent, replace(PROTOCOL, num_envs=n)).episodes if e.policy == "random"]
        for n in (1, 7)
    ]
    assert by_width[0] == by_width[1]


def test_summary_by_hand() -> None:
    suite = vector_suite(lambda task, n: CountingEnvironment(task, n, 9), 4)
    suite = replace(suite, references={"a": Reference(random=1.0, human=11.0, source="hand")})
    episodes = [
        EpisodeScore("agent", "a", i, i, score, length, q, False)
        for i, (score, length, q) in enumerate([(2.0, 10, 0.5), (4.0, 20, 1.5), (9.0, 30, 1.0)])
    ]
    row = summarize(suite, episodes)
    assert (row.mean, row.median, row.mean_length_steps, row.mean_q) == (5.0, 4.0, 20.0, 1.0)
    assert row.standard_error == pytest.approx(math.sqrt(13) / math.sqrt(3))  # variance (9 + 1 + 16) / 2
    assert row.human_normalized == pytest.approx(0.4)


@pytest.mark.slow
def test_one_task_and_unknown_tasks() -> None:
    agent = minatar_agent()
    assert {e.task for e in evaluate_agent(agent, PROTOCOL, ("asterix",)).episodes} == {"asterix"}
    with pytest.raises(TaskError, match="did you mean 'asterix'"):
        evaluate_agent(agent, PROTOCOL, ("astrix",))


@pytest.mark.slow
def test_agent_acts_on_one_observation_and_on_batches() -> None:
    agent = minatar_agent()
    batch = np.random.default_rng(0).integers(0, 2, (5, *agent.suite.observation_shape)).astype(np.uint8)
    actions = agent.act(batch, "asterix")
    assert actions.shape == (5,)
    assert isinstance(agent.act(batch[0], "asterix"), int)
    assert np.array_equal(agent.q_values(batch[0], 1), agent.q_values(batch[0], "asterix"))
    with pytest.raises(TaskError, match="task is 2, expected a name or an index from 0 to 1"):
        agent.q_values(batch[0], 2)
    with pytest.raises(TaskError, match="has shape"):
        agent.act(batch[0, 0], "asterix")


def gym_agent(suite_fields: dict[str, Any]) -> Agent:
    suite = replace(vector_suite(lambda task, n: CountingEnvironment(task, n, 9), 4), **suite_fields)
    return small_agent(suite)


def test_observations_of_any_container_and_type_are_the_same_numbers() -> None:
    agent = gym_agent({})
    x = np.random.default_rng(0).normal(size=(3, 4)).astype(np.float32)
    expected = agent.q_values(x, 0)
    tensor = torch.tensor(x, requires_grad=True)
    for given in (x.tolist(), tensor, tensor.double(), x.astype(np.float64), x.astype(">f4"), x[:, ::-1][:, ::-1]):
        assert np.array_equal(agent.q_values(given, 0), expected)
    assert np.array_equal(agent.q_values(tensor[0], 0), expected[0])
    assert np.array_equal(agent.q_values([1, 2, 3, 4], 0), agent.q_values(np.asarray([1, 2, 3, 4], np.float32), 0))
    assert agent.q_values(torch.zeros(2, 4, dtype=torch.bfloat16), 0).shape == expected[:2].shape


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ([0.0, np.nan, 0.0, 0.0], "has values from nan to nan, expected finite numbers"),
        (np.asarray([0.0, 1e300, 0.0, 0.0]), r"has values from 0 to 1e\+300, expected finite numbers \(float32\)"),
        (np.asarray(["a"] * 4), "is of type <U1, expected raw numbers"),
        (np.asarray([1j] * 4), "is of type complex128, expected raw numbers"),
        (np.ma.MaskedArray(np.zeros(4), [0, 0, 1, 0]), r"is a masked array, expected plain numbers; .*filled\(0\)"),
        (None, r"has shape \(\)"),
        ([[1.0], [1.0, 2.0]], r"has shape \(\)"),
    ],
)
def test_what_are_no_observations_is_refused(given: Any, message: str) -> None:
    with pytest.raises(TaskError, match=message):
        gym_agent({}).act(given, 0)


@pytest.mark.parametrize("task", [None, 0.0, 2, -1])
def test_what_are_no_tasks_is_refused(task: Any) -> None:
    with pytest.raises(TaskError, match=f"task is {task}, expected a name or an index from 0 to 1"):
        gym_agent({}).act(np.zeros(4), task)


def test_images_are_taken_as_raw_bytes_only() -> None:
    """Floats in [0, 1] would be scaled a second time, in silence."""
    fields = {"frame_dtype": np.uint8, "scale": 1 / 255, "in_unit_range": True}
    agent = gym_agent(fields)
    pixels = np.asarray([[0, 17, 130, 255]], np.uint8)
    expected = agent.q_values(pixels, 0)
    for given in (pixels.astype(np.int64), pixels.tolist(), torch.tensor(pixels)):
        assert np.array_equal(agent.q_values(given, 0), expected)
    with pytest.raises(TaskError, match="is of type float32, expected raw bytes, as the environment gives them"):
        agent.q_values(pixels / np.float32(255), 0)
    with pytest.raises(TaskError, match="has values from 0 to 256, expected raw ones from 0 to 255"):
        agent.q_values([0, 1, 2, 256], 0)
    with pytest.raises(TaskError, match="has values from 0 to 255, expected raw ones from 0 to 1"):
        gym_agent(fields | {"scale": 1.0}).q_values(pixels, 0)


def test_a_pickled_agent_decides_alike() -> None:
    agent = minatar_agent(encoding="rate")
    x = np.random.default_rng(0).integers(0, 2, (3, *agent.suite.observation_shape)).astype(np.uint8)
    agent.q_values(x, 0)
    other = pickle.loads(pickle.dumps(agent))  # noqa: S301
    assert other.step == 12
    assert other.environment(0).reset(seed=1)[0].shape == x[0].shape
    for _ in range(2):
        assert np.array_equal(other.q_values(x, 0), agent.q_values(x, 0))


@pytest.mark.slow
def test_environments_of_other_people_are_played_in_the_calling_thread_only() -> None:
    """Their state may be shared between copies: the same protocol gives the same scores."""
    threads: set[int] = set()

    class Watched(CountingEnvironment):
        def step(self, actions):  # type: ignore[no-untyped-def]
            threads.add(threading.get_ident())
            return super().step(actions)

    suite = vector_suite(lambda task, n: Watched(task, n, 9), 4)
    agent = small_agent(suite)
    evaluate_agent(agent, PROTOCOL)
    assert threads == {threading.get_ident()}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["GlobalRandom", "SampledActions"])
def test_an_evaluation_repeats_itself_where_environments_draw_from_global_generators(name: str) -> None:
    suite = make_suite(TasksConfig(suite="gym", names=(f"tests.tasks.odd_envs:{name}-v0",)))
    agent = small_agent(suite)
    one, two = (evaluate_agent(agent, PROTOCOL) for _ in range(2))
    assert one == two
    assert len({episode.score for episode in one.episodes if episode.policy == "random"}) == 7


@pytest.mark.slow
def test_an_episode_that_does_not_end_is_cut_off_and_announced() -> None:
    suite = make_suite(TasksConfig(suite="gym", names=("tests.tasks.odd_envs:Endless-v0",)))
    notes: list[str] = []
    result = evaluate_agent(small_agent(suite), replace(PROTOCOL, max_episode_steps=40), note=notes.append)
    assert {(e.length_steps, e.truncated) for e in result.episodes} == {(40, True)}
    assert len(result.episodes) == 14
    assert len(notes) == 2, "one for each policy, not for each of three groups of episodes"
    assert notes[0].endswith(
        "an episode of the agent policy has not ended after 40 steps; it is cut off here "
        "(evaluation.max_episode_steps), with the return that it has"
    )
    assert "episodes of at most 40 steps" in str(result.protocol)


@pytest.mark.parametrize("thread_safe", [False, True])
def test_an_evaluation_stops_when_it_is_asked_to(thread_safe: bool) -> None:
    suite = make_suite(TasksConfig(suite="gym", names=("tests.tasks.odd_envs:Endless-v0",)))
    asked: list[int] = []
    with pytest.raises(EvaluationStopped):
        evaluate_agent(
            small_agent(replace(suite, thread_safe=thread_safe)),
            PROTOCOL,
            stop=lambda: asked.append(1) or len(asked) > 20,  # type: ignore[func-returns-value]
        )
    assert len(asked) < 60


@pytest.mark.parametrize("thread_safe", [False, True])
def test_an_interrupt_ends_the_parts_that_are_running(thread_safe: bool) -> None:
    """KeyboardInterrupt in the calling thread: endless parts end, or this test never does."""
    started = threading.Event()

    def part(number: int) -> None:
        started.set()
        if not thread_safe:
            raise KeyboardInterrupt
        while True:
            work.check()

    def interrupted() -> None:
        nonlocal work
        with parts(in_threads=thread_safe) as work:
            results = work.map(part, range(50))
            if thread_safe:
                assert started.wait()
                raise KeyboardInterrupt
            list(results)

    work = Parts(None)
    with pytest.raises(KeyboardInterrupt):
        interrupted()


def test_an_agent_acts_as_the_environment_counts_actions() -> None:
    config = small_config(tasks={"suite": "gym", "names": ["tests.tasks.odd_envs:Offset-v0"]})
    suite = make_suite(config.tasks)
    agent = Agent(build_network(config.network, observation_spec(suite), 3), suite, config, torch.device("cpu"), 12)
    batch = np.random.default_rng(0).normal(size=(50, 4)).astype(np.float32)
    greedy = agent.q_values(batch, 0).argmax(axis=1)
    assert set(agent.act(batch, 0)) <= {-1, 0, 1}
    assert np.array_equal(agent.act(batch, 0), greedy - 1)
    assert agent.act(batch[0], 0) == greedy[0] - 1
    assert metadata(fold_agent(agent))["first_actions"] == {"tests.tasks.odd_envs:Offset-v0": -1}


@pytest.mark.parametrize("env_id", ["Grey-v0", "ChannelsLast-v0", "ChannelsFirst-v0", "Planes-v0"])
def test_an_agent_takes_the_images_of_its_environment(env_id: str) -> None:
    """The loop of docs/extending.md, compared with the frame that training makes of the same observation."""
    name = f"tests.tasks.odd_envs:{env_id}"
    config = small_config(tasks={"suite": "gym", "names": [name]})
    suite = make_suite(config.tasks)
    agent = Agent(build_network(config.network, observation_spec(suite), 3), suite, config, torch.device("cpu"), 12)
    observation, _ = make_environment(name).reset(seed=4)
    frame = suite.make(0, 1).reset(np.zeros(1, np.int64), np.asarray([4]))[0]
    assert np.array_equal(agent.q_values(observation, name), agent.q_values(frame, name))
    assert isinstance(agent.act(observation, name), int)


def test_protocol_is_said_in_words() -> None:
    text = str(EvaluationProtocol.of(EvaluationConfig(), TasksConfig()))
    for part in ("30 episodes", "epsilon 0.05", "raw return", "seed", "sticky actions 0", "fire on reset", "108,000"):
        assert part in text


OLD_PROTOCOL = {
    "episodes": 30, "epsilon": 0.05, "seed": 1, "num_envs": 8, "sticky_action_probability": 0.25,
    "fire_on_reset": False, "noop_max": 7, "frame_skip": 3, "max_episode_frames": 5000,
    "score": "raw return, unclipped",
}  # fmt: skip
"""As version 0.1.0 stored it, for every suite."""


@pytest.mark.parametrize("suite", SUITE_DEFAULTS)
def test_a_stored_protocol_of_any_version_says_the_same_as_the_config(suite: str) -> None:
    tasks = TasksConfig(
        suite=suite,
        sticky_action_probability=0.25,
        fire_on_reset=False,
        noop_max=7,
        frame_skip=3,
        max_episode_frames=5000,
    )
    protocol = EvaluationProtocol.of(EvaluationConfig(episodes=30, epsilon=0.05, seed=1, num_envs=8), tasks)
    assert EvaluationProtocol.from_dict(OLD_PROTOCOL | {"suite": suite}) == protocol
    assert EvaluationProtocol.from_dict(json.loads(json.dumps(asdict(protocol)))) == protocol


def test_a_protocol_lists_only_what_its_suite_knows() -> None:
    gym = EvaluationProtocol.of(EvaluationConfig(), TasksConfig(suite="gym", names=("CartPole-v1",)))
    assert gym.environment == ()
    assert "sticky" not in str(gym)
    minatar = EvaluationProtocol.of(EvaluationConfig(), TasksConfig(suite="minatar", names=("breakout",)))
    assert minatar.environment == ("all 6 actions", "sticky actions 0", "frame cap 108,000")


def test_published_rows_are_the_papers() -> None:
    rows = {(policy, task): mean for policy, task, mean in published_rows(AtariSuite, ["pong", "breakout", "enduro"])}
    assert rows["SwitchMT (paper)", "breakout"] == 5.6
    assert rows["MTSpark_ADD (paper)", "enduro"] == 371.2
    assert rows["human (Wang 2016)", "pong"] == 14.6
    assert rows["random (Wang 2016)", "pong"] == -20.7
