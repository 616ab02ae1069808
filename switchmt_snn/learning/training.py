"""Algorithm 1 of the paper: one spiking Q-network learns several tasks and switches between them.

``Training.events`` is the loop: a generator of events. It knows no screen and no file. Its caller decides when to
save and when to stop; the state is whole whenever a ``Stepped`` event is yielded.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from switchmt_snn.config import ExperimentConfig, clips_rewards
from switchmt_snn.errors import TrainingFailed, require_saved
from switchmt_snn.learning.clocks import Every, linear_decay
from switchmt_snn.learning.events import EpisodeEnded, Event, Measured, Stepped, SwitchDecided
from switchmt_snn.learning.exploration import Exploration
from switchmt_snn.learning.measuring import layer_health, updates_to_settle
from switchmt_snn.learning.parts import make_learner, make_replay
from switchmt_snn.learning.return_scale import make_return_scales
from switchmt_snn.learning.saved_values import require_sound
from switchmt_snn.learning.state import Stateful
from switchmt_snn.learning.statistics import reestimate_from_replay
from switchmt_snn.learning.switching import EpisodeRecord, Stay, SwitchingPolicy, SwitchTo
from switchmt_snn.replay.ring import Returns
from switchmt_snn.spiking.network import QNetwork
from switchmt_snn.tasks.play import Play, episode_seed
from switchmt_snn.tasks.suite import TaskSuite, VectorStep
from switchmt_snn.updates.processes import ProcessGroup


class Training(Stateful):
    """One run of Algorithm 1.

    Attributes:
        steps: agent steps made, over all tasks.
        steps_by_task: agent steps made in each task.
        task: index i of the current task.
    """

    SAVED = (
        "learner",
        "replays",
        "return_scales",
        "policy",
        "task",
        "visit",
        "steps",
        "steps_by_task",
        "steps_in_visit",
        "updates_in_visit",
        "episodes_in_visit",
        "episodes_by_task",
        "starts_by_task",
        "explore_rng",
        "exploration",
        "sample_rng",
        "update_clock",
        "target_clock",
        "metrics_clock",
    )
    DERIVED = ("config", "suite", "num_envs", "reproducible", "_plays", "_thread")

    def __init__(
        self, config: ExperimentConfig, suite: TaskSuite, device: torch.device, group: ProcessGroup | None = None
    ) -> None:
        """Prepare a run from a resolved config; nothing is played yet.

        Args:
            config: resolved.
            suite: its tasks.
            device: the network's.
            group: the processes among which updates are divided; None for one process.

        Raises:
            ConfigError: the network, the engine or the switching policy cannot be made.
        """
        self.config, self.suite = config, suite
        self.num_envs = config.tasks.num_envs
        num_tasks = len(suite.names)
        seeds = np.random.SeedSequence(config.seed).spawn(4)
        self.learner = make_learner(config, suite, device, group)  # Q, Q*
        self.replays = [make_replay(config, suite, device) for _ in suite.names]  # D_1 ... D_|E|
        self.return_scales = make_return_scales(config, num_tasks)
        self.policy = SwitchingPolicy(config.switching, num_tasks, [suite.references.get(name) for name in suite.names])
        self.task = 0
        self.visit = 0
        self.steps = 0
        self.steps_by_task = [0] * num_tasks
        self.steps_in_visit = 0
        self.updates_in_visit = 0  # from the current task's replay
        self.episodes_in_visit = 0
        self.episodes_by_task = [0] * num_tasks  # episodes that ended
        self.starts_by_task = [0] * num_tasks  # episodes that began; numbers their seeds
        self.explore_rng = np.random.default_rng(seeds[1])
        longest_steps = config.learning.longest_random_action_steps
        longest_K_steps = config.learning.longest_random_action_steps_by_task or (longest_steps,) * num_tasks
        self.exploration = Exploration(longest_K_steps, self.num_envs)
        self.sample_rng = np.random.default_rng(seeds[2])
        self.update_clock = Every(config.learning.update_every_steps)
        learning = config.learning
        self.target_clock = Every(learning.target_update_every_updates or learning.target_update_every_steps)
        self.metrics_clock = Every(config.recording.metrics_every_steps)
        self.reproducible = True
        self._thread: ThreadPoolExecutor | None = None
        self._plays: dict[int, Play] = {}  # made at a task's first visit; a task that is left keeps its episodes

    def events(self) -> Iterator[Event]:
        """Run until ``total_steps``; every event carries the step at which it happened.

        Raises:
            TrainingFailed: a loss or a parameter is no longer finite.
        """
        if self.visit == 0:
            self._enter(self.task)
        while self.steps < self.config.total_steps:
            play = self._play(self.task)
            task, epsilon = self.task, self.epsilon()
            warming_up = self.is_warming_up(task)
            actions = self.select_actions(play, 1.0 if warming_up else epsilon)  # a via epsilon-greedy
            if self.config.learning.overlap:
                played = self._step_while_learning(play, actions)
            else:
                played = self._store(actions, play.step(actions))  # observe r and s', store in D_i
                self._learn()  # sample from D_i, gradient step
            yield from self._end_episodes(play, played, epsilon)  # terminal: H_i, Eq. 3, maybe i <- i + 1 mod |E|
            if self.config.learning.target_update_every_updates is None:
                self._copy_target(passed=self.num_envs)
            self._change_tasks()
            if self.metrics_clock.advance(self.num_envs):
                yield self.measure()
            yield Stepped(self.steps, task, epsilon, warming_up)

    def epsilon(self) -> float:
        """Exploration now: linear decay over the run's steps, or over those of the current task."""
        learning = self.config.learning
        step = self.steps if learning.epsilon_clock == "total" else self.steps_by_task[self.task]
        return linear_decay(learning.epsilon_start, learning.epsilon_end, learning.epsilon_decay_steps, step)

    def is_warming_up(self, task: int) -> bool:
        """Whether a task's buffer is not sampled yet; its actions are random until then."""
        return self.replays[task].transitions_added < self.config.learning.learning_starts_steps

    def select_actions(self, play: Play, epsilon: float) -> npt.NDArray[np.int64]:
        """Epsilon-greedy over the actions that exist in the task; the same random draws whatever the network says."""
        valid = np.flatnonzero(self.suite.valid_actions_KA[self.task])
        explore, actions = self.exploration.choose(self.task, valid, epsilon, self.explore_rng)
        if not explore.all():
            greedy = self.learner.act(play.observations, self.task)
            actions = np.where(explore, actions, greedy)
        return actions

    def _step_while_learning(self, play: Play, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step on another thread, and learn from what D_i held before the step (``learning.overlap``)."""
        stepping = self._step_on_thread(play, actions)
        self._learn()
        return self._store(actions, stepping.result())

    def _step_on_thread(self, play: Play, actions: npt.NDArray[np.int64]) -> Future[VectorStep]:
        """Begin a step on another thread; the environments share nothing with the learner and the replay."""
        if self._thread is None:
            self._thread = ThreadPoolExecutor(1, "environments")
        return self._thread.submit(play.step, actions)

    def _store(self, actions: npt.NDArray[np.int64], played: VectorStep) -> VectorStep:
        """Store the transitions of a vector step in D_i, and count its steps."""
        replay, terminal = self.replays[self.task], played.terminated
        if self.config.learning.life_loss_is_terminal and played.lives_lost is not None:
            terminal = terminal | played.lives_lost  # for targets; the episode goes on
        if self.return_scales:
            self.return_scales[self.task].add(played.rewards, terminal | played.truncated)
        for env in range(self.num_envs):
            replay.add(env, int(actions[env]), float(played.rewards[env]), bool(terminal[env]), played.frames[env])
        self.steps += self.num_envs
        self.steps_by_task[self.task] += self.num_envs
        self.steps_in_visit += self.num_envs
        return played

    def _learn(self) -> None:
        """The updates that are due, from the current task's buffer or from every task's in turn."""
        learning = self.config.learning
        returns = Returns(learning.n_steps, learning.discount, clips_rewards(self.config))
        updates = self.update_clock.advance(self.num_envs) * learning.updates_per_round
        if updates > 0:
            for task, scale in enumerate(self.return_scales):
                self.learner.set_scale(task, scale.value)
        for _ in range(updates):
            tasks = [self.task] if learning.update_tasks == "current" else range(len(self.replays))
            for task in tasks:
                if not self.is_warming_up(task):
                    batch = self.replays[task].sample(learning.batch_size, self.sample_rng, returns)
                    self.learner.update(batch, task)
                    self.updates_in_visit += task == self.task
                    if learning.target_update_every_updates is not None:
                        self._copy_target(passed=1)

    def _copy_target(self, passed: int) -> None:
        """Copy the target network if it is due, after so many more steps or updates."""
        for _ in range(self.target_clock.advance(passed)):
            self.reestimate_statistics()
            self.learner.copy_target()  # Q* <- Q

    def _end_episodes(self, play: Play, played: VectorStep, epsilon: float) -> Iterator[Event]:
        """Report ended episodes, ask the policy, and start what comes next (Algorithm 1, lines 13-20)."""
        task = self.task
        switch: SwitchTo | None = None
        for env in played.ended:
            self.exploration.end(task, int(env))
            self.episodes_by_task[task] += 1
            self.episodes_in_visit += 1
            episode_return = float(play.returns[env])
            yield EpisodeEnded(
                step=self.steps,
                task=task,
                episode=self.episodes_by_task[task],
                episode_return=episode_return,
                length_steps=int(play.lengths_steps[env]),
                truncated=bool(played.truncated[env]) and not bool(played.terminated[env]),
                epsilon=epsilon,
                updates=self.learner.updates,
            )
            record = EpisodeRecord(
                task=task,
                episodes_in_visit=self.episodes_in_visit,
                steps_in_visit=self.steps_in_visit,
                updates=self.learner.updates,
                updates_in_visit=self.updates_in_visit,
                episode_return=episode_return,
                parameters=self.learner.parameters,
                observations=partial(self._observations, task),
                values=partial(self.learner.q_values, task=task),
                silent_shares=partial(self.learner.silent_shares, task=task),
            )
            decision = self.policy.judge(record, left=switch is not None)
            yield self._decided(decision)
            if isinstance(decision, SwitchTo):
                switch = decision
        if switch is None and self.policy.must_leave(self.steps_in_visit):
            switch = self.policy.leave(task, self.steps_in_visit)
            yield self._decided(switch)
        if switch is not None:
            self.policy.start_visit()
            self._enter(switch.task)
        else:
            self._begin_episodes()

    def _observations(self, task: int, count: int) -> Tensor:
        """Observations of a task's replay for its criterion; the step seeds the draw."""
        rng = np.random.default_rng((self.config.seed, self.steps, task))
        drawn = self.replays[task].sample(count, rng, Returns()).observations
        return (drawn if isinstance(drawn, Tensor) else torch.from_numpy(drawn)).cpu()

    def _decided(self, decision: Stay | SwitchTo) -> SwitchDecided:
        return SwitchDecided(self.steps, self.task, self.visit, self.episodes_in_visit, self.steps_in_visit, decision)

    def _enter(self, task: int) -> None:
        """Begin a visit. Episodes that were running when the task was left continue."""
        self.visit += 1
        self.task = task
        self.steps_in_visit = 0
        self.updates_in_visit = 0
        self.episodes_in_visit = 0
        self._reestimate(task, self.learner.network)
        self._begin_episodes()

    def reestimate_statistics(self) -> None:
        """Estimate every task's running statistics anew, if ``learning.reestimate_statistics_batches`` says so.

        The draws depend on the step only, so a second call at a step gives the same statistics.
        """
        for task in range(len(self.replays)):
            self._reestimate(task, self.learner.network)

    def settle_acting_network(self) -> None:
        """Estimate the acting network's statistics anew, before it is evaluated. Those of Q* are: since its copy."""
        if self.learner.acting_network is self.learner.network:
            self.reestimate_statistics()

    def settled_acting_network(self) -> QNetwork:
        """The acting network as ``settle_acting_network`` would make it: a copy, or where it does nothing, its own."""
        acts = self.learner.acting_network
        if self.config.learning.reestimate_statistics_batches == 0 or acts is self.learner.target:
            return acts
        network = copy.deepcopy(acts)
        for task in range(len(self.replays)):
            self._reestimate(task, network)
        return network

    def _reestimate(self, task: int, network: QNetwork) -> None:
        learning, replay = self.config.learning, self.replays[task]
        if learning.reestimate_statistics_batches == 0 or self.is_warming_up(task):
            return
        batches, seed = learning.reestimate_statistics_batches, (self.config.seed, self.steps, task)
        reestimate_from_replay(network, task, replay, batches, learning.batch_size, seed)

    def _begin_episodes(self) -> None:
        """Start an episode in every copy of the current task that has none."""
        play = self._play(self.task)
        env_ids = np.flatnonzero(play.over)
        if len(env_ids) == 0:
            return
        first = self.starts_by_task[self.task]
        numbers = range(first, first + len(env_ids))
        seeds = [episode_seed(self.config.seed, self.task, number) for number in numbers]
        self.starts_by_task[self.task] += len(env_ids)
        frames = play.begin(env_ids, np.asarray(seeds, np.int64))
        for env, frame in zip(env_ids, frames, strict=True):
            self.replays[self.task].begin(int(env), frame)

    def _play(self, task: int) -> Play:
        if task not in self._plays:
            self._plays[task] = Play(self.suite.at(self.steps), task, self.num_envs)
        return self._plays[task]

    def _change_tasks(self) -> None:
        """At ``tasks.later_from_steps``: the running episodes of tasks that change are cut off, others go on."""
        now, later = self.suite.at(self.steps), self.suite.later
        if later is None or now is self.suite:
            return
        for task in [task for task in later.changed if task in self._plays and self._plays[task].suite is not now]:
            self._plays.pop(task).close()
            for env in range(self.num_envs):
                self.exploration.end(task, env)
            if self.return_scales:
                self.return_scales[task].end()
        self._begin_episodes()

    def measure(self) -> Measured:
        """Means since the last report and the health of every neuron layer on the current task.

        Health is left out until the task's running statistics have left their initial values.

        Raises:
            TrainingFailed: a loss or a parameter is not finite.
        """
        self.check_finite()
        means = self.learner.take_means()
        replay, layers = self.replays[self.task], {}
        if self._updates_while_played(self.task) >= updates_to_settle(self.learner.network):
            layers = layer_health(self.learner, replay, self.task, self.steps)
        return Measured(
            step=self.steps,
            task=self.task,
            updates=self.learner.updates,
            loss=means.get("loss"),
            q=means.get("q"),
            steps_by_task=tuple(self.steps_by_task),
            layers=layers,
        )

    def _updates_while_played(self, task: int) -> int:
        """About how many updates a task has had in its own steps; -1 while it is warming up."""
        learning = self.config.learning
        steps = self.replays[task].transitions_added - learning.learning_starts_steps
        return -1 if steps < 0 else steps // learning.update_every_steps * learning.updates_per_round

    def check_finite(self) -> None:
        """Raise TrainingFailed if a loss or a parameter is not finite; a checkpoint never holds such a network."""
        if not self.learner.is_finite():
            raise TrainingFailed(
                f"the loss is not finite after {self.learner.updates} updates (step {self.steps}), expected a number; "
                "the last checkpoint is from before it; try a lower learning.learning_rate, learning.loss=huber or "
                "learning.gradient_clip=norm"
            )

    def state_dict(self) -> dict[str, object]:
        """The whole run, the running and the paused episodes included."""
        plays = {str(task): play.state_dict() for task, play in sorted(self._plays.items())}
        return {**super().state_dict(), "plays": plays}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue a run; ``reproducible`` says whether its episodes repeated themselves from seed and actions.

        Raises:
            CheckpointError: the state is not whole, or of another run.
        """
        require_saved(state, ("plays",), type(self).__name__)
        older: dict[str, Any] = {
            "return_scales": [],
            "updates_in_visit": 0,
        }  # what states of older versions lack, and do not use
        if max(self.exploration.longest_K_steps) == 1:
            older["exploration"] = self.exploration.state_dict()
        super().load_state_dict({**older, **state})
        require_sound(self, state["plays"])
        replayed = [self._play(int(task)).load_state_dict(play) for task, play in state["plays"].items()]
        self.reproducible = all(replayed)

    def close(self) -> None:
        """Free the environments."""
        if self._thread is not None:
            self._thread.shutdown()
        for play in self._plays.values():
            play.close()
        self.learner.close()
