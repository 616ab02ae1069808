"""Copies in processes of their own: they play what copies in this process play; a process that ends is one line."""

from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import time
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors.torch import load_file

from switchmt_snn import train
from switchmt_snn.config import ExperimentConfig, TasksConfig, from_dict
from switchmt_snn.errors import ConfigError, TaskError
from switchmt_snn.tasks import gym_processes
from switchmt_snn.tasks.gym_processes import GymProcesses
from switchmt_snn.tasks.play import Play
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite
from tests.tasks import odd_envs

pytestmark = pytest.mark.slow

ODD = odd_envs.__name__


def suite_of(*names: str, subprocesses: bool = True, **settings: Any) -> TaskSuite:
    return make_suite(TasksConfig(suite="gym", names=names, subprocesses=subprocesses, **settings))


@pytest.mark.parametrize(
    ("names", "settings"),
    [
        (("CartPole-v1", "Acrobot-v1"), {}),  # the second has more numbers in its frames, and more actions
        ((f"{ODD}:GlobalRandom-v0",), {}),
        ((f"{ODD}:SampledActions-v0",), {}),
        ((f"{ODD}:Composed-v0",), {"wrappers": ("FlattenObservation",)}),
        ((f"{ODD}:Plain-v0",), {"wrappers": (f"{ODD}:Halves",)}),
        ((f"{ODD}:Combined-v0",), {"wrappers": ("FlattenAction",)}),
        ((f"{ODD}:FaintImage-v0",), {}),
    ],
)
def test_they_play_as_copies_in_this_process_do(names: tuple[str, ...], settings: dict[str, Any]) -> None:
    suites = [suite_of(*names, subprocesses=subprocesses, **settings) for subprocesses in (False, True)]
    for task in range(len(names)):
        plays = [Play(suite, task, 3) for suite in suites]
        rng, number = np.random.default_rng(task), 3
        firsts = [play.begin(np.arange(3), np.asarray([0, 1, 2])) for play in plays]
        assert np.array_equal(*firsts)
        actions = np.flatnonzero(suites[0].valid_actions_KA[task])
        ended_alone = False
        for _ in range(120):
            chosen = rng.choice(actions, 3)
            ours, theirs = (play.step(chosen) for play in plays)
            for field in ("frames", "rewards", "terminated", "truncated"):
                assert np.array_equal(getattr(ours, field), getattr(theirs, field)), field
                assert getattr(ours, field).dtype == getattr(theirs, field).dtype, field
            if len(ours.ended):
                ended_alone |= len(ours.ended) < 3
                seeds = np.arange(number, number + len(ours.ended))
                number += len(seeds)
                assert np.array_equal(*(play.begin(ours.ended, seeds) for play in plays))
        assert ended_alone or names[task] != "CartPole-v1", "no reset of some copies only"
        for play in plays:
            play.close()


def played(play: Play, steps: int) -> None:
    for _ in range(steps):
        play.step(np.zeros(play.num_envs, np.int64))


@pytest.mark.parametrize("name", ["Raises", "NanReward", "ShortObservation"])
def test_what_is_wrong_with_an_environment_is_said_in_the_same_line(name: str) -> None:
    lines = []
    for subprocesses in (False, True):
        play = Play(suite_of(f"{ODD}:{name}-v0", subprocesses=subprocesses), 0, 2)
        play.begin(np.arange(2), np.asarray([0, 1]))
        with pytest.raises(TaskError) as error:
            played(play, steps=40)
        lines.append(str(error.value))
        play.close()
    assert lines[0] == lines[1]


def test_a_process_that_is_killed_is_an_error_and_the_others_end() -> None:
    play = Play(suite_of("CartPole-v1"), 0, 3)
    play.begin(np.arange(3), np.asarray([0, 1, 2]))
    processes = play._environment._environment._vector.processes  # type: ignore[attr-defined]
    processes[1].kill()
    processes[1].join()
    with pytest.raises(TaskError, match=r"a process of task 'CartPole-v1' has ended, .* tasks\.subprocesses=false"):
        play.step(np.zeros(3, np.int64))
    play.close()
    for process in processes:
        process.join(10)
        assert not process.is_alive()


def test_an_interrupt_while_the_processes_start_ends_those_that_have(monkeypatch: pytest.MonkeyPatch) -> None:
    """The server is up by then: what it starts later would miss what has been freed, with a traceback."""
    seen: list[tuple[int, bool]] = []

    def interrupted(*_: Any, context: str, **__: Any) -> None:
        multiprocessing.get_context(context).Process(target=time.sleep, args=(60,)).start()
        seen.append((len(multiprocessing.active_children()), gym_processes._start_server.cache_info().currsize == 1))
        raise KeyboardInterrupt

    monkeypatch.setattr(gym_processes, "AsyncVectorEnv", interrupted)
    before = len(multiprocessing.active_children())
    with pytest.raises(KeyboardInterrupt):
        suite_of("CartPole-v1").make(0, 1)
    assert seen == [(before + 1, True)]
    assert len(multiprocessing.active_children()) == before


def test_a_warning_of_the_copies_is_heard_here_once(capfd: pytest.CaptureFixture[str]) -> None:
    """DoubleObservation gives lists, of which Gymnasium's checker warns; nothing warns of the registered id."""
    tasks = suite_of(f"{ODD}:DoubleObservation-v0")
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("default")
        for _ in range(2):
            play = Play(tasks, 0, 2)
            play.begin(np.arange(2), np.arange(2))
            play.step(np.zeros(2, np.int64))
            play.close()
    told = [str(one.message) for one in heard if Path(one.filename).name == "passive_env_checker.py"]
    assert len(told) == len(set(told)) == 2  # of reset and of step
    assert not [one for one in heard if "already in registry" in str(one.message)]
    assert "Warning" not in capfd.readouterr().err


def test_other_suites_refuse_it() -> None:
    with pytest.raises(ConfigError, match=r"tasks\.subprocesses is True, expected the default for the suite 'minatar'"):
        make_suite(TasksConfig(suite="minatar", names=("breakout",), subprocesses=True))


def config(subprocesses: bool) -> ExperimentConfig:
    return from_dict(
        {
            "total_steps": 400,
            "threads": 1,
            "tasks": {"suite": "gym", "names": ["CartPole-v1"], "num_envs": 2, "subprocesses": subprocesses},
            "network": {"hidden_units": 8, "timesteps": 2},
            "learning": {"batch_size": 8, "learning_starts_steps": 20, "replay_capacity_steps": 600},
            "evaluation": {"episodes": 2},
            "recording": {"checkpoint_every_steps": 100},
        }
    )


def weights(run: Path) -> dict[str, Any]:
    return load_file(max(run.glob("checkpoints/step-*")) / "model.safetensors")


def test_a_run_learns_and_continues_as_one_without_processes(tmp_path: Path) -> None:
    train(config(False), tmp_path / "here")
    train(replace(config(True), total_steps=200), tmp_path / "processes")
    train(config(True), tmp_path / "processes")
    here, processes = weights(tmp_path / "here"), weights(tmp_path / "processes")
    assert here.keys() == processes.keys()
    assert all((here[name] == processes[name]).all() for name in here)
    assert (tmp_path / "here" / "episodes.csv").read_text().count("\n") > 3


def test_ctrl_c_in_a_terminal_stops_cleanly(tmp_path: Path) -> None:
    """It reaches every process of the group; only the main one heeds it."""
    command = [sys.executable, "-m", "switchmt_snn", "train", "cartpole", "--run", "run", "--tasks.subprocesses"]
    process = subprocess.Popen(
        command, cwd=tmp_path, start_new_session=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    episodes = tmp_path / "run" / "episodes.csv"
    until = time.monotonic() + 120
    while not (episodes.exists() and episodes.read_text().count("\n") > 2):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < until
        time.sleep(0.1)
    os.killpg(process.pid, signal.SIGINT)
    out, errors = process.communicate(timeout=120)
    assert "continue exactly here" in out + errors
    assert "Traceback" not in out + errors
    assert GymProcesses.__name__ not in errors
