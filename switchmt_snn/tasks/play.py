"""Playing a task: frame stacks, episode seeds, and the actions since each episode's start.

An episode is a function of its seed and its actions (see ``TaskEnvironment``), so a
checkpoint needs no emulator state: it stores seed and actions of the running episodes, and ``Play.load_state_dict``
plays them again.
"""

from __future__ import annotations

import hashlib
from typing import Any

import numpy as np
import numpy.typing as npt

from switchmt_snn.errors import CheckpointError, require_saved, shown
from switchmt_snn.tasks.contract import CheckedEnvironment
from switchmt_snn.tasks.suite import Frames, Picture, TaskSuite, VectorStep


def episode_seed(root: int, task: int, episode: int) -> int:
    """Seed of an episode, from the run's root seed, the task index and the episode's number within the task."""
    return int(np.random.SeedSequence([root, task, episode]).generate_state(1)[0] & 0x7FFF_FFFF)


class Play:
    """``num_envs`` copies of one task in play.

    Attributes:
        observations: stacked observations ``[n, k*c, ...]``, oldest frame first; zeros before an episode's start (as
            AtariVectorEnv stacks).
        returns: raw return of each running episode.
        lengths_steps: length of each running episode.
        over: copies without a running episode; ``begin`` must start one before the next ``step``.
    """

    def __init__(self, suite: TaskSuite, task: int, num_envs: int) -> None:
        self.suite, self.task = suite, task
        self.num_envs = num_envs
        self._environment = CheckedEnvironment(suite, task, num_envs)
        self._channels = suite.frame_shape[0]
        self.observations: Frames = np.zeros((num_envs, *suite.observation_shape), suite.frame_dtype)
        self.returns = np.zeros(num_envs)
        self.lengths_steps = np.zeros(num_envs, np.int64)
        self.over = np.ones(num_envs, np.bool_)
        self._seeds = np.zeros(num_envs, np.int64)
        self._actions: list[list[int]] = [[] for _ in range(num_envs)]

    def begin(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start episodes; returns their first frames ``[len(env_ids), ...]``."""
        frames = self._environment.reset(env_ids, seeds)
        self.observations[env_ids] = 0
        self.observations[env_ids, -self._channels :] = frames
        self.returns[env_ids] = 0.0
        self.lengths_steps[env_ids] = 0
        self.over[env_ids] = False
        self._seeds[env_ids] = seeds
        for env_id in env_ids:
            self._actions[env_id] = []
        return frames

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Play one step in every copy. Ended copies keep their last observation until ``begin``."""
        result = self._environment.step(actions)
        c = self._channels
        self.observations[:, :-c] = self.observations[:, c:]
        self.observations[:, -c:] = result.frames
        self.returns += result.rewards
        self.lengths_steps += 1
        self.over[result.ended] = True
        for env_id, action in enumerate(actions.tolist()):
            self._actions[env_id].append(action)
        return result

    def picture(self, env_id: int) -> Picture | None:
        """A copy as people see the game ``[H, W, 3]``; None unless it is of ``TaskSuite.pictured`` and has a picture.

        It shows the present state: after an episode's last step its end, until ``begin``.
        """
        return self._environment.picture(env_id)

    def close(self) -> None:
        """Free the environments."""
        self._environment.close()

    def state_dict(self) -> dict[str, Any]:
        """Seeds and actions of the running episodes, and a fingerprint of what they led to."""
        return {
            "task": self.task,
            "seeds": self._seeds.copy(),
            "actions": [np.asarray(actions, np.int32) for actions in self._actions],
            "fingerprint": self._fingerprint(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> bool:
        """Play the stored episodes again.

        Returns:
            Whether the environments led to the same observations and returns. False means that the environment is
            not reproducible from its seed; its episodes are then wherever the actions led.

        Raises:
            CheckpointError: the state is not whole, or of another number of copies.
        """
        require_saved(state, ("task", "seeds", "actions", "fingerprint"), type(self).__name__)
        stored = len(state["seeds"]), len(state["actions"])
        if state["task"] != self.task:
            raise CheckpointError(
                f"the checkpoint has episodes of task {shown(state['task'])}, expected some of task {self.task}; start "
                "a new run with --run"
            )
        if stored != (self.num_envs, self.num_envs):
            raise CheckpointError(
                f"the checkpoint has {stored[0]} seeds and {stored[1]} lists of actions of a task, expected "
                f"{self.num_envs} of each for tasks.num_envs={self.num_envs}; set it as it was, or start a new run "
                "with --run"
            )
        journals = [np.asarray(actions, np.int64) for actions in state["actions"]]
        seeds = np.asarray(state["seeds"], np.int64)
        longest = max(len(journal) for journal in journals)
        all_envs = np.arange(self.num_envs)
        # Copies are stepped together, so a copy with a shorter episode is started later, when as many steps are left.
        self.begin(all_envs, seeds)
        for step in range(longest + 1):
            starting = np.asarray([e for e in all_envs if len(journals[e]) == longest - step], np.int64)
            if len(starting) and step > 0:
                self.begin(starting, seeds[starting])
            if step == longest:
                break
            actions = np.zeros(self.num_envs, np.int64)
            for env_id, journal in enumerate(journals):
                played = step - (longest - len(journal))
                if played >= 0:
                    actions[env_id] = journal[played]
            played_step = self.step(actions)
            early = np.asarray([e for e in played_step.ended if len(journals[e]) < longest - step], np.int64)
            if len(early):
                self.begin(early, seeds[early])
        return self._fingerprint() == str(state["fingerprint"])

    def _fingerprint(self) -> str:
        digest = hashlib.sha256(self.observations.tobytes())
        digest.update(self.returns.tobytes())
        digest.update(self.lengths_steps.tobytes())
        return digest.hexdigest()
