"""Gymnasium environments of other people: what they return, how actions count, images, randomness, wrappers."""

from __future__ import annotations

import copy
import random
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from switchmt_snn.config import TasksConfig
from switchmt_snn.config.plugins import import_plugin_module
from switchmt_snn.errors import ConfigError, TaskError
from switchmt_snn.tasks.gym import GymSuite
from switchmt_snn.tasks.gym_copies import is_outside
from switchmt_snn.tasks.gym_make import make_environment
from switchmt_snn.tasks.gym_spaces import RoundedObservation, frame_layout, num_actions, rounding
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite

MODULE = "tests.tasks.odd_envs"


def suite_of(*names: str, **settings: Any) -> TaskSuite:
    return make_suite(TasksConfig(suite="gym", names=tuple(f"{MODULE}:{name}-v0" for name in names), **settings))


def begun(suite: TaskSuite, num_envs: int = 1, seed: int = 3) -> Play:
    play = Play(suite, 0, num_envs)
    play.begin(np.arange(num_envs), seed + np.arange(num_envs))
    return play


def rewards(suite: TaskSuite, steps: int = 20, num_envs: int = 1) -> list[list[float]]:
    """Of every step, all copies with action 0."""
    play = begun(suite, num_envs)
    return [play.step(np.zeros(num_envs, np.int64)).rewards.tolist() for _ in range(steps)]


@pytest.mark.parametrize(
    ("name", "message"),
    [
        (
            "ShortObservation",
            r"gave an observation of shape \(2,\), expected \(4,\), the shape of its obs",
        ),
        ("LongObservation", r"gave an observation of shape \(9,\), expected \(4,\)"),
        (
            "DictObservation",
            r"gave the dict \{'a': 0.5, 'b': array\(\[0., 0., 0.\]\)\} as observation, expected an array of "
            r"shape \(4,\) and type float32, as its observation_space says; return what it declares, or declare what "
            "it returns$",
        ),
        ("TupleObservation", r"gave the tuple \(array\(\[0., 0.\]\), .*\) as observation, expected an array of shape"),
        ("UnequalObservation", r"gave the list \[\[0.0\], \[1.0, 2.0\], 0.0, 0.0\] as observation, expected an array"),
        ("NoObservation", "gave the NoneType None as observation, expected an array"),
        ("OneNumber", "gave the int 3 as observation, expected an array"),
        ("TextObservation", "gave an observation of type <U1, expected float32, the type of its observation_space"),
        ("NanObservation", "gave observations from nan to nan, expected finite numbers"),
        ("HugeObservation", "gave observations from inf to inf, expected finite numbers"),
        ("MaskedObservation", r"gave a masked array as observation, expected plain numbers; .* array.filled\(0\)$"),
        ("NanReward", r"gave the rewards \[nan\], expected finite numbers"),
        ("InfiniteReward", r"gave the rewards \[inf\], expected finite numbers"),
        ("HugeReward", r"gave the rewards \[-1e\+39\], expected finite numbers"),
        ("TextReward", "gave reward = '1', expected one number; mend the environment's reward"),
        ("ListReward", r"gave reward = \[1\.0\], expected one number"),
        ("TwoRewards", r"gave reward = array\(\[ 0., -1.\]\), expected one number; make it one in a wrapper"),
        ("WideByte", "gave an observation of type int64, expected uint8"),
        ("WideUnsignedByte", "gave an observation of type uint16, expected uint8"),
        ("GradientReward", r"fails in step \(RuntimeError: .*\), expected step\(action\) -> \(observation, reward, "),
        ("WholeReward", r"fails in step \(OverflowError: .*\), expected step\(action\) -> \(observation, reward, "),
        ("Raises", r"fails in step \(ZeroDivisionError: division by zero at odd_envs.py, line \d+\)"),
    ],
)
def test_what_an_environment_returns_is_compared_with_its_spaces_at_every_step(name: str, message: str) -> None:
    play = begun(suite_of(name))
    for _ in range(25):
        play.step(np.asarray([0]))
    with pytest.raises(TaskError, match=f"task '{MODULE}:{name}-v0' {message}") as caught:
        play.step(np.asarray([0]))
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore")  # Gymnasium's own checker asks for an array
def test_a_reset_without_info_is_named() -> None:
    """Gymnasium's own checker only warns."""
    with pytest.raises(TaskError, match=r"gave array\(\[0., 0.\].*\) from reset, expected \(observation, info\)"):
        begun(suite_of("ResetWithoutInfo"))


@pytest.mark.filterwarnings("ignore")  # as above
def test_a_reset_without_options_is_told_gymnasiums_signature_and_not_a_suites() -> None:
    expected = r"keyword argument 'options'\), expected reset\(\*, seed=None, options=None\) -> \(observation, info\)$"
    with pytest.raises(TaskError, match=expected):
        begun(suite_of("ResetWithoutOptions"))


@pytest.mark.parametrize(
    ("dtype", "high", "seen", "noted"),
    [
        (np.float32, 1e30, 1e30, False),
        (np.int16, 32767, 32767, False),
        (np.int32, 2**24 - 1, 100, False),
        (np.int32, 2**24, 100, True),
        (np.uint32, 2**32 - 1, 0, True),
        (np.int64, 2**62, 0, True),
        (np.float64, np.inf, 2**24 - 1, False),
        (np.float64, np.inf, 2**24, True),
    ],
)
def test_whole_numbers_that_float32_rounds_are_noted(dtype: type, high: float, seen: float, noted: bool) -> None:
    assert (rounding(gymnasium.spaces.Box(0, high, (2,), dtype), seen) is not None) == noted


@pytest.mark.filterwarnings("ignore:.*obs:UserWarning")  # as above
def test_large_float64_numbers_are_told_when_they_first_come() -> None:
    play = begun(suite_of("GrowingDouble"))
    for _ in range(25):
        play.step(np.asarray([0]))
    with pytest.warns(RoundedObservation, match="gives float64 observations above 16,777,216; networks take float32"):
        play.step(np.asarray([0]))
    assert float(play.observations[0, 0]) == 2**24 + 4  # not 2**24 + 3


@pytest.mark.filterwarnings("ignore")  # as above
def test_an_environment_that_cannot_be_closed_is_named() -> None:
    with pytest.raises(TaskError, match=r"fails in close \(RuntimeError: still open at odd_envs.py, line \d+\)"):
        suite_of("CannotClose")


@pytest.mark.filterwarnings("ignore")  # as above
def test_numbers_that_a_space_can_hold_are_taken() -> None:
    play = begun(suite_of("DoubleObservation"))
    play.step(np.asarray([0]))
    assert play.observations.tolist() == [[1.0, 0.5, 1.0, 2.0]]


def test_actions_with_an_offset_reach_the_environment_as_it_counts_them() -> None:
    suite = suite_of("Offset")
    assert suite.action_names == ("action_-1", "action_0", "action_1")
    play = begun(suite)
    assert [float(play.step(np.asarray([action])).rewards[0]) for action in range(3)] == [0.0, 0.0, 1.0]


def test_tasks_with_other_offsets_share_outputs_that_are_numbered() -> None:
    suite = suite_of("Offset", "Plain")
    assert suite.first_actions == (-1, 0)
    assert [suite.first_action(task) for task in range(2)] == [-1, 0]
    assert suite.action_names == ("output_0", "output_1", "output_2")


def test_actions_beyond_16_bits_are_played_and_played_again() -> None:
    suite = suite_of("ManyActions")
    play = begun(suite)
    assert play.step(np.asarray([39_999])).rewards[0] == 39_999
    again = Play(suite, 0, 1)
    assert again.load_state_dict(play.state_dict())
    assert again.returns[0] == 39_999


@pytest.mark.parametrize("name", ["ChannelsFirst", "ChannelsLast"])
def test_the_shape_of_an_image_says_where_its_channels_are(name: str) -> None:
    suite = suite_of(name)
    assert suite.frame_shape == (4, 10, 10)
    frame = begun(suite).observations[0]
    assert frame[:, 0, 0].tolist() == [0, 1, 2, 3]
    assert frame[0, :, 0].tolist() == list(range(0, 100, 10))


def layout(shape: tuple[int, ...]) -> str:
    from switchmt_snn.tasks.gym_spaces import frame_layout

    return frame_layout("a", gymnasium.spaces.Box(0, 255, shape, np.uint8), "by_shape").kind


@pytest.mark.parametrize(
    ("shape", "kind"),
    [
        ((84, 84), "grey"),
        ((84, 84, 3), "channels_last"),
        ((210, 160, 3), "channels_last"),
        ((10, 10, 7), "channels_last"),
        ((5, 5, 16), "channels_last"),
        ((84, 84, 1), "channels_last"),
        ((4, 84, 84), "channels_first"),
        ((3, 210, 160), "channels_first"),
        ((16, 5, 5), "channels_first"),
        ((7,), "vector"),
    ],
)
def test_the_layout_that_a_shape_says(shape: tuple[int, ...], kind: str) -> None:
    assert layout(shape) == kind


@pytest.mark.parametrize("shape", [(10, 10, 10), (3, 5, 3), (4, 4, 10), (7, 3, 3), (10, 20, 12)])
def test_a_shape_that_does_not_say_its_layout_is_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(TaskError, match=r"does not say which axis holds the channels; set tasks\.image_layout"):
        layout(shape)


def test_the_layout_of_an_image_can_be_stated() -> None:
    last = begun(suite_of("AnyAxis", image_layout="channels_last")).observations[0]
    first = begun(suite_of("AnyAxis", image_layout="channels_first")).observations[0]
    assert last[:, 0, 0].tolist() == list(range(10))
    assert first[0, 0].tolist() == list(range(10))


def test_truth_values_are_frames_of_zeros_and_ones() -> None:
    suite = suite_of("Planes")
    assert (suite.scale, suite.in_unit_range) == (1.0, True)
    assert begun(suite).observations.max() == 1


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (
            ("FloatGrid",),
            r"expected uint8 or bool: 2 dimensions are taken for an image; if they are none, set task",
        ),
        (("Composed",), r"expected a Box; set tasks\.wrappers=\[FlattenObservation\]"),
        (("Mission",), r"expected a Box; choose its numbers in a wrapper \(tasks\.wrappers=\[module:Name\]\)"),
        (("Combined",), r"expected Discrete: .* set tasks\.wrappers=\[FlattenAction\]"),
        (("Planes", "ChannelsLast"), "mix images of uint8 and of bool"),
        (("Plain", "ChannelsLast"), "mix images and vectors"),
    ],
)
def test_a_refusal_says_what_to_do(names: tuple[str, ...], message: str) -> None:
    with pytest.raises(TaskError, match=message):
        suite_of(*names)


def test_a_refusal_names_all_wrappers_that_a_task_needs() -> None:
    with pytest.raises(TaskError, match=r"set tasks\.wrappers=\[FlattenAction,FlattenObservation\]$"):
        suite_of("ComposedAndCombined", wrappers=("FlattenAction",))
    with pytest.raises(TaskError, match=r"set tasks\.wrappers=\[FlattenObservation,FlattenAction\]"):
        suite_of("ComposedAndCombined", wrappers=("FlattenObservation",))
    assert suite_of("ComposedAndCombined", wrappers=("FlattenObservation", "FlattenAction")).frame_shape == (16,)


def test_an_id_that_a_module_registers_in_gym_is_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    gym = SimpleNamespace(envs=SimpleNamespace(registry={"Old-v0": None}))
    monkeypatch.setitem(sys.modules, "gym", gym)
    with pytest.raises(TaskError, match="registers it in gym, which came before Gymnasium"):
        suite_of("Old")


def test_an_environment_that_exits_is_one_line() -> None:
    play = begun(suite_of("Exits"))
    with pytest.raises(TaskError, match=r"fails in step \(SystemExit: 3 at odd_envs\.py, line \d+\)"):
        play.step(np.asarray([0]))


def test_composed_observations_are_flattened_on_request() -> None:
    suite = suite_of("Composed", wrappers=("FlattenObservation",))
    assert suite.frame_shape == (16,)
    assert begun(suite).observations[0].tolist() == [7.0] * 9 + [0, 1, 1, 0] + [0, 0, 1]


def test_every_combination_of_a_small_multidiscrete_space_is_an_action_on_request() -> None:
    suite = suite_of("Combined", wrappers=("FlattenAction",))
    assert suite.num_actions == 6
    play = begun(suite)
    seen = [float(play.step(np.asarray([action])).rewards[0]) for action in range(6)]
    assert seen == [1.0, 2.0, 3.0, 11.0, 12.0, 13.0]


def test_too_many_combinations_are_refused() -> None:
    with pytest.raises(TaskError, match=r"would make 900 actions of MultiDiscrete.*expected at most 512; choose some"):
        suite_of("TooManyCombinations", wrappers=("FlattenAction",))


def test_a_wrapper_of_ones_own_is_named_by_its_module() -> None:
    play = begun(suite_of("Plain", wrappers=(f"{MODULE}:Halves",)))
    play.step(np.asarray([0]))
    assert play.observations[0, 0] == np.float32(0.05)
    assert make_environment("CartPole-v1", (f"{MODULE}:Halves",)).spec is not None


def test_wrappers_that_do_not_exist_or_do_not_fit_are_named() -> None:
    with pytest.raises(ConfigError, match=r"tasks\.wrappers is 'FlatenAction'.*did you mean 'FlattenAction'"):
        TasksConfig(suite="gym", names=("CartPole-v1",), wrappers=("FlatenAction",))
    with pytest.raises(TaskError, match="FlattenAction meets the action space Discrete"):
        suite_of("Plain", wrappers=("FlattenAction",))
    with pytest.raises(ConfigError, match=r"tasks\.wrappers is .*expected the default for the suite 'minatar'"):
        make_suite(TasksConfig(suite="minatar", names=("breakout",), wrappers=("FlattenObservation",)))


@pytest.mark.parametrize(
    ("name", "wrappers"),
    [
        ("GlobalRandom", ()),
        ("TorchRandom", ()),
        ("SampledActions", ()),
        ("SampledGoal", ()),
        ("Plain", (f"{MODULE}:Sampling",)),
    ],
)
def test_episodes_that_draw_from_what_reset_does_not_seed_are_functions_of_their_seed(
    name: str, wrappers: tuple[str, ...]
) -> None:
    suite = suite_of(name, wrappers=wrappers)
    alone = rewards(suite)
    assert rewards(suite) == alone
    assert [row[0] for row in rewards(suite, num_envs=3)] == [row[0] for row in alone]
    assert len({row[0] for row in alone}) > 1


def test_the_global_generators_of_everybody_else_stay_as_they_are() -> None:
    def seeded() -> None:
        random.seed(5)
        np.random.seed(5)
        torch.manual_seed(5)

    def drawn() -> tuple[float, ...]:
        return random.random(), np.random.rand(), np.random.randn(), float(torch.rand(()))

    seeded()
    expected = drawn()
    for name in ("GlobalRandom", "TorchRandom", "DrawnWhenMade"):
        seeded()
        play = begun(suite_of(name))
        play.step(np.asarray([0]))
        assert drawn() == expected


def test_an_environment_made_again_is_the_same_environment() -> None:
    (level,) = {row[0] for row in rewards(suite_of("DrawnWhenMade"))}
    assert rewards(suite_of("DrawnWhenMade"), num_envs=3)[0] == [level] * 3


def test_an_empty_observation_is_not_told_to_flatten() -> None:
    empty = gymnasium.spaces.Box(-1.0, 1.0, (0,), np.float32)
    with pytest.raises(TaskError, match=r"none empty\); let it observe something"):
        frame_layout("a", empty, "by_shape")


def test_only_environments_of_gymnasium_itself_are_played_in_several_threads_and_kept() -> None:
    """Random play of code that no version names is played again for each evaluation."""
    suite = make_suite(TasksConfig(suite="gym", names=("CartPole-v1",)))
    assert (suite.thread_safe, suite.versioned) == (True, True)
    assert (suite_of("Plain").thread_safe, suite_of("Plain").versioned) == (False, False)
    wrapped = TasksConfig(suite="gym", names=("CartPole-v1",), wrappers=(f"{MODULE}:Halves",))
    assert (make_suite(wrapped).thread_safe, make_suite(wrapped).versioned) == (False, False)
    assert (suite_of("ShortCartPole").thread_safe, suite_of("ShortCartPole").versioned) == (False, False)


@pytest.mark.parametrize(
    ("name", "wrappers"),
    [("NoisyCartPole-v0", ()), ("CartPole-v1", (f"{MODULE}:noisy",)), (f"{MODULE}:NoisyCartPole-v0", ())],
)
def test_a_function_of_ones_own_in_a_class_of_gymnasium_is_code_of_ones_own(
    name: str, wrappers: tuple[str, ...]
) -> None:
    """Its episodes are a function of their seed, are played in one thread, and random play is not kept."""
    import_plugin_module(MODULE)
    suite = make_suite(TasksConfig(suite="gym", names=(name,), wrappers=wrappers))
    assert (suite.thread_safe, suite.versioned) == (False, False)
    played = rewards(suite, 5)
    assert played == rewards(suite, 5)
    assert {reward for row in played for reward in row}.isdisjoint({0.0, 1.0})


def test_arguments_that_hold_code_are_code_of_ones_own() -> None:
    import_plugin_module(MODULE)
    env = gymnasium.make("CartPole-v1")
    assert not is_outside(env)
    for spec in (gymnasium.spec("OwnCartPole-v0"), gymnasium.spec("NoisyCartPole-v0")):
        env.unwrapped.spec = spec
        assert is_outside(env)


def test_how_an_id_is_registered_decides_random_play(monkeypatch: pytest.MonkeyPatch) -> None:
    suite = GymSuite(TasksConfig(suite="gym", names=("CartPole-v1",)))
    before = suite.registered
    spec = copy.deepcopy(gymnasium.registry["CartPole-v1"])
    spec.max_episode_steps = 7
    monkeypatch.setitem(gymnasium.registry, "CartPole-v1", spec)
    assert suite.registered != before
    assert GymSuite(TasksConfig(suite="gym", names=("CartPole",))).registered["CartPole"] == repr(spec)


@pytest.mark.parametrize("names", [("CartPole-v1", "gymnasium:CartPole-v1"), ("CartPole", "CartPole-v1")])
@pytest.mark.filterwarnings("ignore:.*latest versioned")
def test_two_names_of_one_environment_are_refused(names: tuple[str, str]) -> None:
    with pytest.raises(
        TaskError, match=f"tasks {names[0]} and {names[1]} are both CartPole-v1, expected every task once"
    ):
        make_suite(TasksConfig(suite="gym", names=names))


@pytest.mark.filterwarnings("ignore:.*latest versioned")
def test_an_id_without_its_version_is_drawn() -> None:
    pytest.importorskip("pygame")
    play = Play(make_suite(TasksConfig(suite="gym", names=("CartPole",))).pictured(), 0, 1)
    play.begin(np.arange(1), np.arange(1))
    assert play.picture(0) is not None


@pytest.mark.filterwarnings("ignore")  # Gymnasium's own checker asks for bytes
def test_a_picture_of_numbers_above_1_is_refused() -> None:
    play = Play(suite_of("FloatPicture").pictured(), 0, 1)
    play.begin(np.arange(1), np.arange(1))
    with pytest.raises(
        TaskError, match="gave a picture of float64 from 200 to 200, expected uint8, or numbers from 0 to"
    ):
        play.picture(0)


def test_more_actions_than_a_network_has_outputs_for_are_refused() -> None:
    for count in (10**5 + 1, 2**40):
        with pytest.raises(TaskError, match=rf"has {count:,} actions, expected at most 100,000: a Q-network"):
            num_actions("a", gymnasium.spaces.Discrete(count))
    assert num_actions("a", gymnasium.spaces.Discrete(10**5)) == 10**5


@pytest.mark.parametrize("raised", ["ImportError", "RuntimeError", "KeyError"])
def test_a_name_that_is_looked_up_when_asked_for_may_fail(
    raised: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / f"lazy_{raised}.py").write_text(f"def __getattr__(name):\n    raise {raised}('no')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    wrapped = TasksConfig(suite="gym", names=("CartPole-v1",), wrappers=(f"lazy_{raised}:A",))
    with pytest.raises(ConfigError, match=rf"looking it up fails \({raised}: .* at lazy_{raised}.py, line 2\)"):
        make_suite(wrapped)


def test_the_wrapper_of_the_examples_sets_one_number_at_a_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[2] / "examples"))
    wrapped = make_environment("Pendulum-v1", ["my_wrapper:OneAxis"])
    assert wrapped.action_space == gymnasium.spaces.Discrete(3)
    assert [float(wrapped.action(action)[0]) for action in range(3)] == [0.0, -2.0, 2.0]  # its torque
    with pytest.raises(TaskError, match=r"the action space is Discrete\(3\), expected a Box with finite bounds"):
        make_environment(f"{MODULE}:Plain-v0", ["my_wrapper:OneAxis"])
