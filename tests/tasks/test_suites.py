"""Every registered suite: its facts agree with its environments; suites and tasks that are wrong are named."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import version
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from switchmt_snn.config import ExperimentConfig, SuiteDefaults, TasksConfig, resolve
from switchmt_snn.config.suites import SUITE_DEFAULTS
from switchmt_snn.errors import ConfigError, TaskError
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.runs.environment import describe_environment
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.check import check_before_training, check_suite
from switchmt_snn.tasks.registry import SUITES, find_suite, make_suite, register_suite, suite_of
from switchmt_snn.tasks.suite import Reference, Suite, TaskSuite
from tests.conftest import CountingEnvironment, vector_suite

NAMES = tuple(SUITES)


def example(name: str) -> TasksConfig:
    return TasksConfig(suite=name, names=SUITES[name].examples)


def test_the_config_knows_every_suite_and_its_defaults() -> None:
    assert {name: suite.defaults for name, suite in SUITES.items()} == SUITE_DEFAULTS
    assert [suite.name for suite in SUITES.values()] == list(SUITES)


@pytest.mark.slow
@pytest.mark.parametrize("name", NAMES)
def test_environments_do_what_their_suite_says(name: str) -> None:
    """Shape, type and range of frames, valid actions, and the same episode for the same seed and actions."""
    tasks = make_suite(example(name))
    assert len(tasks.names) >= 2
    check_suite(tasks, 60)


@pytest.mark.parametrize("name", NAMES)
def test_an_open_config_becomes_a_network_for_the_suites_observations(name: str) -> None:
    config = resolve(ExperimentConfig(tasks=example(name)))
    assert config.tasks.frame_stack == SUITES[name].defaults.frame_stack
    assert config.network.trunk == SUITES[name].defaults.trunk
    tasks = make_suite(config.tasks)
    build_network(config.network, observation_spec(tasks), 0)


@pytest.mark.parametrize("name", NAMES)
def test_facts_name_what_exists(name: str) -> None:
    suite = suite_of(example(name))
    known = set(suite.known_tasks())
    assert set(suite.examples) <= known
    assert set(suite.references) <= known
    for row in suite.published:
        assert set(row.scores) <= known
        assert row.source
        assert all(map(math.isfinite, row.scores.values()))
    for reference in suite.references.values():
        assert reference.human != reference.random
        assert reference.source
    assert all(path.is_file() for path in suite.files.values())
    assert all(version(package) for package in suite.packages)
    assert all(word.isprintable() and "," not in word.replace(",000", "") for word in suite.protocol)
    rate = suite.decisions_per_s
    assert rate is None or rate * suite.frame_skip == suite.frames_per_s


@pytest.mark.parametrize("name", NAMES)
def test_a_run_stores_the_suites_versions_and_files(name: str) -> None:
    facts = describe_environment(ExperimentConfig(tasks=example(name)), torch.device("cpu"))
    assert set(SUITES[name].packages) <= set(facts["versions"])
    assert set(facts["files_sha256"]) == set(suite_of(example(name)).files)


class Counting(Suite):
    """Tasks that count steps."""

    name = "counting"
    defaults = SuiteDefaults(frame_stack=2, trunk="mlp")
    examples = ("a", "b")

    def make(self) -> TaskSuite:
        tasks = vector_suite(lambda task, n: CountingEnvironment(task, n, 5), 4, len(self.config.names), stack=2)
        return replace(tasks, names=self.config.names)


class OpenCounting(Counting):
    """Takes any name."""

    name = "open_counting"
    open_names = True


@pytest.fixture
def counting() -> Iterator[type[Suite]]:
    register_suite(Counting)
    yield Counting
    del SUITES["counting"], SUITE_DEFAULTS["counting"]


def test_a_registered_suite_is_stored_by_the_name_of_its_class(counting: type[Suite]) -> None:
    config = resolve(ExperimentConfig(tasks=TasksConfig(suite="counting", names=("a", "b"))))
    assert config.tasks.suite == "tests.tasks.test_suites:Counting"
    assert (config.tasks.frame_stack, config.network.trunk) == (2, "mlp")
    assert find_suite(config.tasks.suite) is counting
    assert resolve(config) == config
    assert set(suite_of(config.tasks).files) == {"tests.tasks.test_suites"}
    check_suite(make_suite(config.tasks), 20)


def test_a_suite_is_found_by_the_name_of_its_class_without_being_registered() -> None:
    config = TasksConfig(suite="tests.tasks.test_suites:Counting", names=("b",))
    assert make_suite(config).names == ("b",)


@pytest.mark.parametrize("name", NAMES)
def test_an_unknown_task_is_refused(name: str) -> None:
    task = f"{SUITES[name].examples[0]}x"
    with pytest.raises(TaskError, match=f"unknown .*{task!r}.*did you mean {SUITES[name].examples[0]!r}"):
        make_suite(TasksConfig(suite=name, names=(task,)))


def test_a_task_name_that_a_table_cannot_hold_is_refused() -> None:
    with pytest.raises(TaskError, match="expected printable names without commas and quotes"):
        make_suite(TasksConfig(suite="tests.tasks.test_suites:OpenCounting", names=("a,b",)))


def test_a_registered_suite_may_be_registered_again_but_not_take_anothers_name(counting: type[Suite]) -> None:
    assert register_suite(Counting) is Counting
    with pytest.raises(ConfigError, match="has the name 'atari', expected a free short name"):
        register_suite(TakesAtari)


class TakesAtari(Counting):
    """A name that is not free."""

    name = "atari"


class Nameless(Suite):
    """States nothing."""


class Makeless(Suite):
    """States its facts, but makes nothing."""

    name, defaults, examples = "makeless", SuiteDefaults(frame_stack=1, trunk="mlp"), ("a",)


def test_incomplete_suites_are_named() -> None:
    with pytest.raises(ConfigError, match="the suite 'Makeless' defines no make"):
        register_suite(Makeless)
    with pytest.raises(ConfigError, match="the suite 'Nameless' states no name"):
        register_suite(Nameless)
    with pytest.raises(ConfigError, match=r"expected a subclass of switchmt_snn.tasks.suite.Suite"):
        register_suite(dict)  # type: ignore[type-var]
    with pytest.raises(ConfigError, match=r"expected a class with defaults = SuiteDefaults\(\.\.\.\)"):
        ExperimentConfig(tasks=TasksConfig(suite="tests.tasks.test_suites:Nameless", names=("a",)))


@pytest.mark.parametrize("name", ["atary", "", "mujoco"])
def test_an_unknown_suite_is_refused_and_the_known_ones_are_named(name: str) -> None:
    with pytest.raises(ConfigError, match=r"expected atari, minatar, gym, or a class as package.module:Name"):
        TasksConfig(suite=name)  # type: ignore[arg-type]


def test_a_suite_that_makes_other_tasks_than_asked_is_named(counting: type[Suite], monkeypatch) -> None:
    good = counting(TasksConfig(suite="counting", names=("a", "b"))).make()
    wrong = (
        (replace(good, names=("a", "c")), "names"),
        (replace(good, frame_stack=3), "frame_stack 3, expected 2"),
        (replace(good, frame_shape=(2, 2)), "frame_shape"),
        (replace(good, frame_dtype=np.float64), "uint8 or float32"),
        (replace(good, valid_actions_KA=np.zeros((2, 2), np.bool_)), "one or more true in a row"),
        (
            replace(good, valid_actions_KA=[[True, True]] * 2),
            r"valid_actions_KA \[\[True, .*expected an array",
        ),
        (replace(good, valid_actions_KA=np.ones((2, 2), np.int64)), "expected an array of truth values"),
        (replace(good, references={"a": 3.0}), r"references {'a': 3.0}, expected Reference\(random, human, source\)"),
        (replace(good, references={"a": Reference(1.0, 1.0, "x")}), "expected Reference.* two numbers that differ"),
        (replace(good, scale=0.0), "scale 0.0, expected a number above 0"),
        (replace(good, scale="1"), "scale '1', expected a number above 0"),
        (replace(good, in_unit_range="no"), "in_unit_range 'no', expected True or False"),
        (replace(good, frame_dtype="picture"), "frame_dtype 'picture', expected uint8 or float32"),
        (replace(good, frame_shape=4), r"frame_shape 4, expected \(features,\)"),
        (replace(good, action_names="ab"), "action_names 'ab', expected a tuple of texts"),
        (replace(good, first_actions=(0.5, 1)), "expected none, or one whole number for each of 2 tasks"),
        (replace(good, names=(1, 2)), "names .1, 2., expected printable names"),
        (None, "gave None from make, expected a TaskSuite"),
    )
    for tasks, message in wrong:
        monkeypatch.setattr(Counting, "make", lambda self, tasks=tasks: tasks)
        with pytest.raises(TaskError, match=message):
            make_suite(TasksConfig(suite="counting", names=("a", "b")))


def raises(error: Exception) -> Any:
    def code(*_: object) -> None:
        raise error

    return code


@pytest.mark.parametrize("error", [RuntimeError("no robot"), KeyError("a")])
@pytest.mark.parametrize(
    ("attribute", "where"), [("make", "make"), ("known_tasks", "known_tasks"), ("__init__", "its constructor")]
)
def test_what_a_suite_raises_is_one_line(
    counting: type[Suite], monkeypatch: pytest.MonkeyPatch, error: Exception, attribute: str, where: str
) -> None:
    monkeypatch.setattr(Counting, attribute, raises(error))
    with pytest.raises(
        TaskError, match=rf"fails in {where} \({type(error).__name__}: .* at test_suites.py, line"
    ) as caught:
        make_suite(TasksConfig(suite="counting", names=("a", "b")))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("fact", "value", "expected"),
    [
        ("protocol", "no sticky actions", "a tuple of texts"),
        ("protocol", property(raises(KeyError("x"))), r"fails in protocol \(KeyError: 'x' at test_suites.py, line"),
        ("references", {"a": 3.0}, r"Reference\(random, human, source\)"),
        ("published", ("nobody",), "a tuple of PublishedScores"),
        ("frames_per_s", "60", "a number above 0, or None"),
        ("frame_skip", 0, "a whole number above 0"),
        ("steps_to_learn", 1e6, "a whole number above 0, or None"),
        ("process_bytes", 1.5e8, "a whole number of at least 0"),
        ("tasks_with_lives", ("c",), "a tuple of names in"),
        ("packages", "numpy", "a tuple of names"),
        ("masks_actions", "no", "True or False"),
        ("registered", {"levels": 3}, "a text for each name"),
        ("files", {"weights": "weights.bin"}, "a pathlib.Path of a file that exists"),
    ],
)
def test_a_fact_of_a_suite_that_nothing_can_show_or_store_is_named(
    counting: type[Suite], monkeypatch: pytest.MonkeyPatch, fact: str, value: object, expected: str
) -> None:
    monkeypatch.setattr(Counting, fact, value)
    with pytest.raises(TaskError, match=rf"(states {fact} = .*, expected )?{expected}") as caught:
        make_suite(TasksConfig(suite="counting", names=("a", "b")))
    assert f" {fact} " in str(caught.value)


class Forgetful(CountingEnvironment):
    """Counts its resets, so that no episode comes again."""

    resets = 0

    def reset(self, env_ids, seeds):  # type: ignore[no-untyped-def]
        Forgetful.resets += 1
        return super().reset(env_ids, seeds + Forgetful.resets)


def test_check_suite_names_what_an_environment_does_wrong() -> None:
    good = vector_suite(lambda task, n: CountingEnvironment(task, n, 5), 4)
    check_suite(good, 20)
    wrong = (
        (replace(good, frame_shape=(5,)), "frames of shape"),
        (replace(good, frame_dtype=np.uint8), "type float32, expected"),
        (replace(good, in_unit_range=True), "expected values from 0 to 1"),
        (replace(good, make=lambda task, n: Forgetful(task, n, 5)), "differs at step 0 when it is played again"),
    )
    for tasks, message in wrong:
        with pytest.raises(TaskError, match=message):
            check_suite(tasks, 20)


class Wrong(CountingEnvironment):
    """Counts, and changes what a step returns."""

    def __init__(self, task: int, num_envs: int, **changes: object) -> None:
        super().__init__(task, num_envs, 5)
        self.changes = changes

    def step(self, actions):  # type: ignore[no-untyped-def]
        return replace(super().step(actions), **self.changes)


class TupleStep(CountingEnvironment):
    def step(self, actions):  # type: ignore[no-untyped-def]
        result = super().step(actions)
        return result.frames, result.rewards, result.terminated, result.truncated


class FailsInStep(CountingEnvironment):
    def step(self, actions):  # type: ignore[no-untyped-def]
        return self.nothing


class NoClose(CountingEnvironment):
    close = None  # type: ignore[assignment]


class NoReset(CountingEnvironment):
    reset = None  # type: ignore[assignment]


class OtherCount(CountingEnvironment):
    def __init__(self, task: int, num_envs: int, length: int) -> None:
        super().__init__(task, num_envs, length)
        self.num_envs = 7


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda task, n: NoClose(task, n, 5), r"NoClose, which has no close, expected close\(\)"),
        (lambda task, n: NoReset(task, n, 5), "which has no reset"),
        (lambda task, n: OtherCount(task, n, 5), "has num_envs 7, expected the 2"),
        (lambda task, n: TupleStep(task, n, 5), "gave a tuple from step, expected a VectorStep"),
        (lambda task, n: FailsInStep(task, n, 5), r"fails in step \(AttributeError: .* at test_suites.py, line"),
        (lambda task, n: Wrong(task, n, rewards=-0.5), "gave rewards = -0.5, expected an array of 2 numbers"),
        (lambda task, n: Wrong(task, n, terminated=False), "gave terminated = False, expected an array of 2 truth"),
        (lambda task, n: Wrong(task, n, frames=None), "gave a NoneType as frames"),
        (lambda task: None, r"fails in make \(TypeError"),
    ],
)
def test_a_mistake_in_an_environment_is_one_line_before_training(make, message, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    config = ExperimentConfig(tasks=TasksConfig(suite="tests.tasks.test_suites:Counting", names=("a", "b")))
    tasks = make_suite(config.tasks)
    check_before_training(config, tasks)
    with pytest.raises(TaskError, match=message) as caught:
        check_before_training(config, replace(tasks, make=make))
    assert "task 'a'" in str(caught.value)
    assert "\n" not in str(caught.value)


class Still(gymnasium.Env):  # type: ignore[type-arg]
    """Never moves, and ends after some steps."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (3,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        super().reset(seed=seed)
        return np.zeros(3, np.float32), {}

    def step(self, action):  # type: ignore[no-untyped-def]
        return np.zeros(3, np.float32), 0.0, False, False, {}


class ShortFrame(Still):
    def step(self, action):  # type: ignore[no-untyped-def]
        return np.zeros(2, np.float32), 0.0, False, False, {}


class FourValues(Still):
    def step(self, action):  # type: ignore[no-untyped-def]
        return np.zeros(3, np.float32), 0.0, False, {}


class NoInfo(Still):
    def reset(self, *, seed=None, options=None):  # type: ignore[no-untyped-def]
        return np.zeros(3, np.float32)


class NoSpace(Still):
    observation_space = None  # type: ignore[assignment]


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize(
    ("environment", "message"),
    [
        (Still, None),
        (ShortFrame, r"gave an observation of shape \(2,\), expected \(3,\), the shape of its observation_space"),
        (FourValues, r"fails in step \(ValueError: .*truncated, info\)"),
        (NoInfo, r"gave array\(.*\) from reset, expected \(observation, info\)"),
        (NoSpace, "observ"),
    ],
)
def test_a_gymnasium_environment_is_compared_with_its_declaration(environment, message, monkeypatch) -> None:  # type: ignore[no-untyped-def]
    name = f"{environment.__name__}-v0"
    monkeypatch.setattr(gymnasium.envs.registration, "registry", dict(gymnasium.registry))
    gymnasium.register(name, environment, max_episode_steps=4)
    config = ExperimentConfig(tasks=TasksConfig(suite="gym", names=(name,)))
    if message is None:
        check_before_training(config, make_suite(config.tasks))
        return
    with pytest.raises(TaskError, match=message):
        check_before_training(config, make_suite(config.tasks))


def test_a_module_that_registers_nothing_is_told_to() -> None:
    with pytest.raises(TaskError, match="registers none of its classes"):
        make_suite(TasksConfig(suite="gym", names=("tests.conftest:Still-v0",)))
    with pytest.raises(TaskError, match=r"or name a module that does: it seems that tests\.tasks\.\w+ does$"):
        make_suite(TasksConfig(suite="gym", names=("tests.tasks:Nothing-v0",)))
