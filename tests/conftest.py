"""Small suites and configs that tests share."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from switchmt_snn.config import ExperimentConfig, resolve, trust
from switchmt_snn.config.yaml_io import from_dict
from switchmt_snn.runs.plan import decide
from switchmt_snn.tasks.suite import TaskEnvironment, TaskSuite, VectorStep


@pytest.fixture(scope="session", autouse=True)
def _own_key(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """A key of the tests' own, also for the fixtures of whole files, which are made before those of a test."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_STATE_HOME", str(tmp_path_factory.getbasetemp() / "state"))
        yield


@pytest.fixture(autouse=True)
def _own_trust(monkeypatch: pytest.MonkeyPatch) -> None:
    """No module that an earlier test had refused or trusted."""
    monkeypatch.setattr(trust, "known", trust.Known())


@pytest.fixture(autouse=True)
def _one_thread() -> None:
    """One thread, so that parallel test workers do not fight over cores."""
    torch.set_num_threads(1)


def small_config(**changes: dict[str, Any] | Any) -> ExperimentConfig:
    """A resolved config of seconds: mlp on vectors, tiny replay; ``changes`` go over it section by section."""
    base: dict[str, Any] = {
        "name": "test",
        "seed": 7,
        "total_steps": 400,
        "device": "cpu",
        "tasks": {"suite": "gym", "names": ["a", "b"]},
        "network": {"trunk": "mlp", "hidden_units": 16, "timesteps": 2},
        "learning": {
            "batch_size": 8,
            "learning_rate": 0.003,
            "clip_rewards": True,
            "learning_starts_steps": 20,
            "replay_capacity_steps": 500,
            "target_update_every_steps": 50,
            "epsilon_decay_steps": 200,
        },
        "switching": {"window_episodes": 2, "max_stay_steps": 60},
        "recording": {"metrics_every_steps": 50, "checkpoint_every_steps": 100},
    }
    for section, value in changes.items():
        base[section] = {**base[section], **value} if isinstance(value, dict) and section in base else value
    return resolve(from_dict(base))


class CountingEnvironment:
    """Its frame is (task, copy, episode seed, steps in the episode): whoever mixes anything up is caught by it.

    Episodes last ``length`` steps; odd seeds end them by termination, even ones by truncation.
    """

    def __init__(self, task: int, num_envs: int, length: int) -> None:
        self.num_envs, self._task, self._length = num_envs, task, length
        self._seeds = np.zeros(num_envs, np.int64)
        self._steps = np.zeros(num_envs, np.int64)
        self._over = np.ones(num_envs, np.bool_)

    def _frames(self) -> npt.NDArray[np.float32]:
        columns = (np.full(self.num_envs, self._task), np.arange(self.num_envs), self._seeds % 4096, self._steps)
        return np.stack(columns, axis=1).astype(np.float32)

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        self._seeds[env_ids], self._steps[env_ids], self._over[env_ids] = seeds, 0, False
        return self._frames()[env_ids]

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        assert not self._over.any(), "an episode that is over was stepped"
        self._steps += 1
        self._over = self._steps >= self._length
        terminated = self._over & (self._seeds % 2 == 1)
        return VectorStep(self._frames(), self._steps.astype(np.float64), terminated, self._over & ~terminated)

    def close(self) -> None:
        pass


class SameObservationEnvironment:
    """One-step episodes with one and the same observation in every task; the right action is the task's index."""

    def __init__(self, task: int, num_envs: int) -> None:
        self.num_envs, self._task = num_envs, task
        self._frame = np.tile(np.asarray([1.0, 0.5, -0.5], np.float32), (num_envs, 1))

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        return self._frame[env_ids]

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        over = np.ones(self.num_envs, np.bool_)
        rewards = np.where(actions == self._task, 1.0, -1.0)
        return VectorStep(self._frame, rewards, over, np.zeros_like(over))

    def close(self) -> None:
        pass


def vector_suite(
    make: Callable[[int, int], TaskEnvironment], features: int, num_tasks: int = 2, num_actions: int = 2, stack: int = 1
) -> TaskSuite:
    """A suite of vector tasks named a, b, ..."""
    return TaskSuite(
        names=tuple("abcdef"[:num_tasks]),
        frame_shape=(features,),
        frame_dtype=np.float32,
        frame_stack=stack,
        scale=1.0,
        in_unit_range=False,
        action_names=tuple(f"action_{a}" for a in range(num_actions)),
        valid_actions_KA=np.ones((num_tasks, num_actions), np.bool_),
        references={},
        make=make,
    )


def decided(
    config: ExperimentConfig, stored: ExperimentConfig | None = None, processes: int = 1
) -> tuple[ExperimentConfig, tuple[str, ...]]:
    """What a run on a CPU decides, and its notes; of two tasks with four features."""
    suite = vector_suite(lambda task, num_envs: CountingEnvironment(task, num_envs, 5), 4)
    return decide(config, stored, suite, torch.device("cpu"), processes)
