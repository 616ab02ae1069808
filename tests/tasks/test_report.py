"""``check_env``: what it says about each suite's tasks and about environments that people write."""

from __future__ import annotations

import json
import re
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from switchmt_snn import check_env
from switchmt_snn.cli.entry import main
from switchmt_snn.config import from_dict
from switchmt_snn.errors import TaskError
from switchmt_snn.runs.plan import plan
from switchmt_snn.tasks.check import FROM_ITS_SEED, check_before_training, warnings_unless_refused
from switchmt_snn.tasks.registry import SUITES, make_suite
from switchmt_snn.tasks.report import EnvironmentReport

MODULE = "tests.tasks.odd_envs"


def report_of(name: str, **settings: Any) -> EnvironmentReport:
    (report,) = check_env(f"{MODULE}:{name}-v0", steps=120, **settings)
    return report


@pytest.mark.slow
@pytest.mark.parametrize("suite", SUITES)
def test_every_suites_examples_repeat_themselves_in_any_thread(suite: str) -> None:
    reports = check_env(*SUITES[suite].examples, suite=suite, steps=60)
    assert [report.task for report in reports] == list(SUITES[suite].examples)
    for report in reports:
        assert report.repeats
        assert report.starts_afresh
        assert report.same_in_threads
        assert report.played_in_threads
        assert not report.draws_globally
        assert report.steps_per_s > 0


@pytest.mark.slow
def test_the_facts_of_a_plain_environment() -> None:
    report = report_of("Offset")
    assert report.actions == (-1, 0, 1)
    assert (report.layout, report.frame_shape, report.frame_dtype, report.scale) == ("vector", (4,), "float32", 1.0)
    assert report.observed == (0.0, pytest.approx(3.0))
    assert report.episode_lengths == (30, 30, 30, 30)
    assert (report.truncated, report.limit_steps, report.rewards) == (0, None, (0.0, 1.0))
    assert not report.played_in_threads
    assert report.same_in_threads
    assert report.notes == ("every seed gives the same play: episodes of an evaluation differ by random actions only",)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "note"),
    [
        ("OwnUnseeded", "the same seed and actions do not give the same play"),
        ("SharedState", "the same seed and actions do not give the same play"),
        ("KeepsState", "an episode depends on the episodes before it"),
        ("GlobalRandom", "it draws from the global generators"),
        ("GlobalRandom", r"rewards up to \S+: learning\.clip_rewards \(false by default in the suite gym\) leaves"),
        ("Endless", "no episode ended in 120 steps, and the environment has no limit"),
        ("Endless", "observations from 0 to 12 leave the space's bounds from -10 to 10"),
        ("Large", "values up to 3000 reach the network as they are"),
        (
            "Timestamps",
            "its observation_space declares whole numbers up to 2,147,483,647; networks take float32, which",
        ),
        ("DoubleTimestamps", "its observation_space is float64, and gave 16,777,2[0-9]{2}; networks take float32"),
        ("FaintImage", "pixels up to 10 of 255"),
    ],
)
@pytest.mark.filterwarnings("ignore")
def test_what_an_author_should_know_is_a_note(name: str, note: str) -> None:
    assert any(re.match(note, text) for text in report_of(name).notes), report_of(name).notes


class SleepsInStep(gymnasium.Env[Any, Any]):
    """Each step takes three seconds of its own clock."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (3,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)
    now_s = 0.0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(3, np.float32), {}

    def step(self, action: Any) -> Any:
        SleepsInStep.now_s += 3.0
        return np.zeros(3, np.float32), 0.0, False, False, {}


gymnasium.register("SleepsInStep-v0", SleepsInStep)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore")
def test_a_slow_environment_is_played_for_its_time_and_the_result_says_so() -> None:
    said: list[str] = []
    name = f"{__name__}:SleepsInStep-v0"
    settings: dict[str, Any] = {"steps": 1000, "say": said.append, "clock": lambda: SleepsInStep.now_s}
    started = SleepsInStep.now_s
    (report,) = check_env(name, seconds=200.0, **settings)
    assert report.steps == 34, "the first that ends after 100 seconds"
    assert report.ended_by_limit_s == 100.0
    assert report.compared_steps == 2, "100 seconds are 33 steps, and each is compared in 16 plays"
    assert SleepsInStep.now_s - started <= 200.0 + 3.0
    assert report.steps_per_s == pytest.approx(1 / 3)
    assert any(note.startswith("0.333 steps/s: 100,000 steps of one copy take 83.3 hours") for note in report.notes)
    assert said[0] == f"{name}: random play of 1,000 steps, for 100 s at the most"
    assert said[1] == f"{name}: 2 of 1,000 steps in 6 s"
    assert said[-1].startswith(f"{name}: plays 2 steps again")
    (report,) = check_env(name, seconds=1e-9, **settings)
    assert (report.steps, report.compared_steps) == (1, 1), "never none"
    (report,) = check_env(name, seconds=float("inf"), **{**settings, "steps": 300})
    assert (report.steps, report.ended_by_limit_s, report.compared_steps) == (300, None, 200)


@pytest.mark.filterwarnings("ignore")
def test_the_command_says_that_the_limit_ended_the_play(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as done:
        main(["check-env", f"{MODULE}:Plain-v0", "--seconds", "1e-9"])
    assert done.value.code == 0
    out, err = capsys.readouterr()
    assert "0 ended in 1 steps of random play (ended by its limit of 5e-10 s; --seconds raises it)" in out
    assert "plays the same 1 steps again: yes" in out
    assert err.splitlines()[0] == f"{MODULE}:Plain-v0: random play of 1,000 steps, for 5e-10 s at the most"


@pytest.mark.filterwarnings("ignore")
def test_the_command_shortens_a_long_space(capsys: pytest.CaptureFixture[str]) -> None:
    """A flattened dict has a bound for every number."""
    with pytest.raises(SystemExit):
        main(["check-env", f"{MODULE}:ManyBounds-v0", "--steps", "30", "--seconds", "0.1"])
    (line,) = [line for line in capsys.readouterr().out.splitlines() if line.startswith("  space")]
    assert line.endswith("...")
    assert len(line) == len("  space      ") + 120


@pytest.mark.slow
def test_drawing_from_global_generators_is_seen_and_does_not_keep_play_from_repeating() -> None:
    report = report_of("GlobalRandom")
    assert report.draws_globally
    assert report.repeats
    assert not report_of("Plain").draws_globally


@pytest.mark.slow
def test_warnings_of_gymnasiums_checker_are_notes() -> None:
    notes = report_of("DoubleObservation").notes
    assert any("was expecting a numpy array" in note and "\x1b" not in note for note in notes)
    assert not any("__module__" in note for note in report_of("Outdated").notes), "meant for the library's author"


@pytest.mark.slow
def test_what_training_would_refuse_is_refused() -> None:
    with pytest.raises(TaskError, match="gave the rewards"):
        report_of("NanReward")
    with pytest.raises(TaskError, match="FlattenAction"):
        report_of("Combined")
    assert report_of("Combined", wrappers=("FlattenAction",)).actions == tuple(range(6))


def _called(words: list[str], capsys: pytest.CaptureFixture[str]) -> str:
    with pytest.raises(SystemExit) as done:
        main(words)
    assert done.value.code == 0
    return capsys.readouterr().out


@pytest.mark.slow
def test_the_command_prints_the_facts(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["check-env", f"{MODULE}:ChannelsFirst-v0", "--steps", "40"]
    text = _called(words, capsys)
    assert "can be trained" in text
    assert "images, channels first: frames of 4 channels, 10 x 10" in text
    assert "0 to 2" in text
    (facts,) = json.loads(_called([*words, "--json"], capsys))
    assert facts["layout"] == "channels_first"
    assert facts["refused_network"] is None


def test_the_command_says_that_no_network_fits(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["check-env", f"{MODULE}:TooWide-v0", "--steps", "2"]
    text = _called(words, capsys)
    assert "TooWide-v0 (gym): can be played, but train's own network does not fit" in text
    assert "note: network.hidden_units is 128, which makes a layer of 38,400,000 weights for 300,000 inputs" in text
    assert "lower it, or make the observations smaller" in text
    (facts,) = json.loads(_called([*words, "--json"], capsys))
    assert facts["refused_network"].startswith("network.hidden_units is 128")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ([], "was given no environment"),
        ([f"{MODULE}:FloatGrid-v0"], "tasks.wrappers=[FlattenObservation]"),
        (["Nothing-v0"], "named module:Id, such as my_module:Nothing-v0"),
        ([f"{MODULE}:Plain-v0:x"], "has '" + MODULE + ":Plain-v0:x', expected an id such as CartPole-v1, or module:Id"),
        ([f"{MODULE}:"], "expected an id such as CartPole-v1, or module:Id"),
        (["CartPole-v9"], "did you mean 'CartPole-v1'?"),
        (["CartPole-v1", "--steps", "0"], "--steps is 0"),
        (["CartPole-v1", "--seconds", "nan"], "--seconds is nan, expected more than 0"),
    ],
)
def test_the_command_refuses_in_one_line(
    words: list[str], message: str, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    with pytest.raises(SystemExit) as done:
        main(["check-env", *words])
    assert done.value.code == 2
    error = capsys.readouterr().err
    assert message in error
    assert error.count("\n") == 1


class WrongShape(gymnasium.Env[Any, Any]):
    """Gymnasium's checker warns of its observations."""

    observation_space = gymnasium.spaces.Box(0.0, 1.0, (3,), np.float32)
    action_space = gymnasium.spaces.Discrete(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        return np.zeros(4, np.float32), {}


gymnasium.register("WrongShape-v0", WrongShape)


def test_warnings_are_shown_after_the_checks_and_not_with_a_refusal() -> None:
    config = from_dict({"tasks": {"suite": "gym", "names": [f"{__name__}:WrongShape-v0"]}})
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always")
        with pytest.raises(TaskError, match=r"observation of shape \(4,\)"):
            plan(config)
        assert heard == []
        with warnings_unless_refused():
            warnings.warn("kept", stacklevel=1)
    assert [str(seen.message) for seen in heard] == ["kept"]


@pytest.mark.parametrize(
    ("name", "warning"),
    [
        ("OwnUnseeded", r"differs at step \d+ when it is played again with the same seed and actions: "),
        ("SeededWhenMade", "plays an episode otherwise after other episodes than in an environment made anew, "),
    ],
)
def test_a_run_says_before_it_starts_that_an_environment_is_no_function_of_its_seed(name: str, warning: str) -> None:
    """FromItsSeed is the same environment after the remedy was followed."""
    config = from_dict({"tasks": {"suite": "gym", "names": [f"{MODULE}:FromItsSeed-v0", f"{MODULE}:{name}-v0"]}})
    (note,) = check_before_training(config, make_suite(config.tasks))
    assert re.match(f"warning: task '{MODULE}:{name}-v0' {warning}", note)
    assert note.endswith(f"; {FROM_ITS_SEED}")


def test_a_run_says_before_it_starts_that_float32_rounds_observations() -> None:
    config = from_dict({"tasks": {"suite": "gym", "names": [f"{MODULE}:Timestamps-v0"]}})
    (note,) = check_before_training(config, make_suite(config.tasks))
    assert note.startswith(
        f"warning: task '{MODULE}:Timestamps-v0': its observation_space declares whole numbers up to"
    )


def test_a_run_says_before_it_starts_that_its_images_are_dim() -> None:
    config = from_dict({"tasks": {"suite": "gym", "names": [f"{MODULE}:FaintImage-v0"]}})
    (note,) = check_before_training(config, make_suite(config.tasks))
    assert "pixels up to 10 of 255: the network sees 0.039 at most" in note


@pytest.mark.slow
def test_a_run_says_before_it_starts_that_it_clips_rewards() -> None:
    """Clipping is Atari's custom: elsewhere it can change what is best."""
    names = [f"{MODULE}:Plain-v0", f"{MODULE}:LargeRewards-v0"]

    def notes(**learning: Any) -> tuple[str, ...]:
        config = from_dict({"tasks": {"suite": "gym", "names": names}, "learning": learning})
        return check_before_training(config, make_suite(config.tasks))

    (note,) = notes(clip_rewards=True)
    assert note.startswith(
        f"warning: task '{MODULE}:LargeRewards-v0' gave rewards up to 100, and learning.clip_rewards"
    )
    assert note.endswith("(smaller rewards or a Huber loss then help)")
    (note,) = notes(clip_rewards=True, loss="huber")
    assert note.endswith("(smaller rewards then help)")
    assert notes(clip_rewards=False) == notes() == ()
