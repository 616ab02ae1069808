"""Driving a run: new or continued, checkpoints, evaluations, clean stops; for the command line and the library."""

from __future__ import annotations

import shlex
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol

import numpy as np
import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol, EvaluationStopped, evaluate_agent
from switchmt_snn.config import EvaluationConfig, ExperimentConfig, from_dict, load_config, to_dict
from switchmt_snn.errors import CheckpointError, TrainingFailed, WriteError
from switchmt_snn.learning.events import Event, Stepped
from switchmt_snn.learning.parts import make_learner
from switchmt_snn.learning.shared_learner import SharedLearner
from switchmt_snn.learning.switching import Criterion
from switchmt_snn.learning.training import Training
from switchmt_snn.machine.devices import keep_freed_memory
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.replay.ring import Batch
from switchmt_snn.runs.best import BestWeights
from switchmt_snn.runs.changes import note_changes
from switchmt_snn.runs.checkpoint import fitting_weights
from switchmt_snn.runs.environment import describe_environment, signature_facts
from switchmt_snn.runs.folder import RunFolder, check_same_config, claim_new_run
from switchmt_snn.runs.history import read_history
from switchmt_snn.runs.initial_weights import InitialWeights, read_initial_weights
from switchmt_snn.runs.logs import RunLogs
from switchmt_snn.runs.packing import refuse_pretrained
from switchmt_snn.runs.plan import decide, plan, with_classes
from switchmt_snn.runs.random_play import RandomPlay
from switchmt_snn.runs.signals import stop_requests
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import Suite
from switchmt_snn.updates.processes import ProcessGroup, join_processes


class Observer(Protocol):
    """Receives a run's events. It cannot change or stop the run."""

    def start(self, training: Training, folder: RunFolder, resumed_at: int | None) -> None:
        """The run begins (``resumed_at`` is None), or continues at that step."""

    def __call__(self, event: Event) -> None:
        """Something happened."""

    def note(self, text: str) -> None:
        """A text that the user should read."""

    def stop(self) -> None:
        """The training loop has ended."""


@dataclass(frozen=True)
class RunResult:
    """How a call of ``train`` ended.

    Attributes:
        status: ``finished``, ``stopped`` (by a signal; the same command continues), ``already_finished``, or ``served``
            (one of the other processes of ``torchrun``).
        evaluation: the final evaluation of a run that finished.
        solved: ``evaluation.stop_at_returns`` ended it; a larger budget changes nothing.
    """

    path: Path
    status: str
    step: int
    evaluation: Evaluation | None
    solved: bool = False


def train(
    config: ExperimentConfig | str | Path | None = None,
    run: str | Path | None = None,
    observers: Sequence[Observer] = (),
    policy: type[Criterion] | None = None,
    suite: type[Suite] | None = None,
    trust: bool = False,
) -> RunResult:
    """Train, or continue a run.

    Args:
        config: a config, a YAML file, or a preset's name. None continues ``run``, which must hold a run, with its
            stored config; without ``run``, too, it takes the quickstart preset.
        run: run folder. One that holds a run of the same config is continued; None makes a new one under ``runs/``.
        observers: progress displays and the like.
        policy: a switching criterion of your own; it replaces ``switching.policy`` and takes ``switching.options``.
            The run stores its name, so that it can be continued (docs/extending.md, Switching policy).
        suite: a task suite of your own; it replaces ``tasks.suite``, likewise (docs/extending.md, Task and suite).
        trust: let modules that ``run`` names be imported although this user did not make it (SECURITY.md).

    PyTorch's global settings (default dtype and device, autocast, threads, ...) have no effect on a run, and are
    afterwards as before. Under ``torchrun`` the first process does all this, and every update is divided among all
    processes.

    Raises:
        SwitchMTError: wrong use (``exit_code`` 2), or a run that failed (``exit_code`` 1).

    Examples:
        >>> from dataclasses import replace
        >>> from switchmt_snn import load_config, train
        >>> config = load_config("quickstart")
        >>> tasks = replace(config.tasks, suite="gym", names=("CartPole-v1", "Acrobot-v1"), frame_stack=1)
        >>> result = train(replace(config, tasks=tasks, total_steps=300), run="runs/mine")
        >>> result.status, result.step
        ('finished', 300)
    """
    with as_when_started():
        group = join_processes()
        try:
            if group is not None and group.rank > 0:
                return _serve(group)
            return _train(config, run, observers, group, policy, suite, trust)
        finally:
            if group is not None:
                group.leave()


def _train(
    config: ExperimentConfig | str | Path | None,
    run: str | Path | None,
    observers: Sequence[Observer],
    group: ProcessGroup | None,
    policy: type[Criterion] | None,
    suite: type[Suite] | None,
    trust: bool,
) -> RunResult:
    if run is not None:
        refuse_pretrained(run)
    folder = RunFolder(Path(run)) if run is not None else None
    stored = folder.config(trust) if folder is not None and folder.is_run else None
    config = _asked(config, folder, stored)
    config = with_classes(config, policy, suite)
    planned = plan(config, stored) if group is None else plan(config, stored, group.size, group.device(config.device))
    if folder is not None and stored is not None:
        check_same_config(decide(stored, stored, planned.suite, planned.device)[0], planned.config, folder.path)
    torch.backends.cudnn.deterministic = True  # exact resume; benchmark mode would choose kernels by the clock
    threads = planned.config.threads
    if threads is None and folder is not None and stored is not None:
        threads = folder.threads()  # sums have the order that they had
    if threads is not None:
        torch.set_num_threads(threads)
    keep_freed_memory()
    has_checkpoint = folder is not None and stored is not None and bool(folder.checkpoints().paths())
    begun = folder.path if folder is not None and stored is not None else None
    initial = None if has_checkpoint else read_initial_weights(planned.config, planned.suite, begun)
    if folder is None:
        folder = claim_new_run(config.name)
    signature, unsigned = signature_facts(planned.config) if stored is None else ({}, ())
    lock = folder.lock()
    try:
        folder.require_unchanged(stored is not None)
        if stored is None:
            environment = describe_environment(planned.config, planned.device) | signature
            if initial is not None:
                environment["initial_weights"] = initial.facts()
            folder.create(planned.config, environment, config)
        elif stored != planned.config:
            folder.save_config(planned.config)
        if group is not None:
            group.share(to_dict(planned.config))
        training = Training(planned.config, planned.suite, planned.device, group)
        try:
            return _Driver(folder, training, observers, (*planned.notes, *unsigned), initial).run()
        finally:
            training.close()
    finally:
        lock.release()


def _asked(
    config: ExperimentConfig | str | Path | None, folder: RunFolder | None, stored: ExperimentConfig | None
) -> ExperimentConfig:
    """The config that a call asks for; None continues the run of a folder that is named."""
    if isinstance(config, (str, Path)):
        return load_config(config)
    if config is None and folder is not None:
        folder.require()
    return config or stored or load_config("quickstart")


def _serve(group: ProcessGroup) -> RunResult:
    """The other processes of ``torchrun``: a learner that takes its part in every update."""
    config = from_dict(group.share())
    suite = make_suite(config.tasks)
    learner = make_learner(config, suite, group.device(config.device), group)
    assert isinstance(learner, SharedLearner)
    size = config.learning.batch_size // group.size
    observations = np.zeros((size, *suite.observation_shape), suite.frame_dtype)
    numbers = np.zeros(size, np.int64)
    rewards = numbers.astype(np.float32)
    learner.serve(Batch(observations, numbers, rewards, observations, numbers.astype(np.bool_), rewards))
    return RunResult(Path(), "served", learner.updates, None)


class _Driver:
    """One call's worth of a run: feeds observers, saves, evaluates, stops."""

    def __init__(
        self,
        folder: RunFolder,
        training: Training,
        observers: Sequence[Observer],
        notes: Sequence[str],
        initial: InitialWeights | None,
    ) -> None:
        self.notes, self.initial = notes, initial
        self.folder, self.training, self.observers = folder, training, observers
        self.config = training.config
        self.store = folder.checkpoints(self.config.recording.keep_checkpoints)
        self.best = BestWeights(folder, self.config.evaluation, training.suite.names)
        self.logs: RunLogs | None = None
        self.solved = False

    def run(self) -> RunResult:
        """Continue or begin, to the budget or to a stop."""
        training, config = self.training, self.config
        log_sizes, resumed_at, notes = self._restore()
        if resumed_at is not None:
            self.solved = self._is_solved(self.folder.evaluations.mean_returns(resumed_at, config.evaluation))
        at_its_end = self.solved or training.steps >= config.total_steps
        if at_its_end and self._is_evaluated(training.steps, self._final_evaluation()):
            return RunResult(self.folder.path, "already_finished", training.steps, None, self.solved)
        try:
            return self._run(log_sizes, resumed_at, [*self.notes, *notes])
        except WriteError as error:
            raise TrainingFailed(
                f"{error.seen} at step {training.steps}, expected a disk that works and has room; the last whole "
                f"checkpoint is kept: then run the same command with --run {shlex.quote(str(self.folder.path))}"
            ) from error

    def _run(self, log_sizes: dict[str, int] | None, resumed_at: int | None, notes: list[str]) -> RunResult:
        training, path = self.training, self.folder.path
        self.logs = logs = RunLogs(path, training.suite.names, training.policy.columns, log_sizes)
        for observer in self.observers:
            observer.start(training, self.folder, resumed_at)
        for text in notes:
            self._note(text)
        try:
            with stop_requests() as requested:
                if resumed_at is not None:
                    self._make_up_for(resumed_at, requested)
                stopped = requested() and training.steps < self.config.total_steps
                for event in () if self.solved or stopped else training.events():
                    logs(event)
                    for observer in self.observers:
                        observer(event)
                    if isinstance(event, Stepped):
                        self._record(event.step, requested)
                        if self.solved:
                            self._note(f"evaluation.stop_at_returns is reached at step {event.step:,}: training ends")
                            break
                        if requested():
                            stopped = training.steps < self.config.total_steps
                            break
                if not stopped:
                    training.settle_acting_network()
                self._save()
        finally:
            for observer in self.observers:
                observer.stop()
            logs.close()
        if stopped:
            return RunResult(path, "stopped", training.steps, None)
        return RunResult(path, "finished", training.steps, self._evaluate(self._final_evaluation()), self.solved)

    def _make_up_for(self, step: int, requested: Callable[[], bool]) -> None:
        """What a process that was killed after a checkpoint may not have done: judge it, and evaluate."""
        self.best.at_checkpoint(step, self.training.settled_acting_network)
        if self._owes_evaluation(step):
            self._evaluate_in_training(requested)

    def _restore(self) -> tuple[dict[str, int] | None, int | None, list[str]]:
        """Load the newest whole checkpoint, if there is any: log sizes, its step, and what the user should know."""
        if not self.store.paths():
            self._require_no_progress()
            if self.initial is None:
                return None, None, []
            self.initial.give(self.training.learner)
            return None, None, [f"begins with the weights of {self.initial.run} after {self.initial.step:,} steps"]
        loaded = self.store.load(self.training.replays)
        self.store.remove_old(loaded.step)
        with fitting_weights():
            self.training.load_state_dict(loaded.state)
        notes = [f"{text}; continuing from the one before it" for text in loaded.damaged]
        environment = describe_environment(self.config, self.training.learner.device)
        notes += note_changes(self.folder.path, environment, loaded.step)
        if not self.training.reproducible:
            notes.append(
                "the environment did not repeat its running episodes from seed and actions; the run goes on, but not "
                "exactly as it would have without the interruption"
            )
        return loaded.log_sizes, loaded.step, notes

    def _require_no_progress(self) -> None:
        """Refuse to begin anew over the logs of a run that has had a checkpoint: after two periods it had.

        Raises:
            CheckpointError: its checkpoints are gone.
        """
        reached = read_history(self.folder.path, self.training.suite.names).last_step
        if reached >= 2 * self.config.recording.checkpoint_every_steps:
            raise CheckpointError(
                f"{self.store.folder} has no checkpoint, expected one of a run whose logs reach step {reached:,}; put "
                "it back, or begin another run with --run"
            )

    def _record(self, step: int, requested: Callable[[], bool]) -> None:
        """Save and evaluate when a border of their periods was crossed by the last vector step."""
        if self._evaluates_at(step):
            self.training.settle_acting_network()
            self._evaluate_in_training(requested)
        before = step - self.training.num_envs
        every = self.config.recording.checkpoint_every_steps
        if step // every > before // every and step < self.config.total_steps and not self.solved:
            self._save()

    def _evaluates_at(self, step: int) -> bool:
        """Whether training is evaluated at a step."""
        before, every = step - self.training.num_envs, self.config.evaluation.every_steps
        return every is not None and step // every > before // every and step < self.config.total_steps

    def _owes_evaluation(self, step: int) -> bool:
        """Whether the evaluation of the step at which a run goes on was stopped."""
        return self._evaluates_at(step) and not self._is_evaluated(step, self.config.evaluation)

    def _is_evaluated(self, step: int, settings: EvaluationConfig) -> bool:
        """Whether every task was; ``evaluate --task`` plays one."""
        return set(self.training.suite.names) <= self.folder.evaluations.mean_returns(step, settings).keys()

    def _evaluate_in_training(self, requested: Callable[[], bool]) -> None:
        """Evaluate. A request to stop ends it; it is played again when the run goes on."""
        try:
            evaluation = self._evaluate(self.config.evaluation, requested)
        except EvaluationStopped:
            return
        self.solved = self._is_solved({row.task: row.mean for row in evaluation.tasks if row.policy == "agent"})

    def _save(self) -> None:
        assert self.logs is not None
        training = self.training
        training.check_finite()
        acting = self.config.learning.acting_network
        self.store.save(training.steps, training.state_dict(), training.replays, self.logs.sync(), acting)
        self.best.at_checkpoint(training.steps, training.settled_acting_network)

    def _is_solved(self, means: dict[str, float]) -> bool:
        """Whether an evaluation's mean returns by task reach ``evaluation.stop_at_returns``."""
        goals = self.config.evaluation.stop_at_returns
        names = self.training.suite.names
        return bool(goals) and all(
            name in means and means[name] >= goal for name, goal in zip(names, goals, strict=True)
        )

    def _final_evaluation(self) -> EvaluationConfig:
        """The last evaluation's settings: other episodes than those that chose when to stop."""
        evaluation = self.config.evaluation
        return replace(evaluation, seed=evaluation.seed + 1) if self.solved else evaluation

    def _evaluate(self, settings: EvaluationConfig, stop: Callable[[], bool] | None = None) -> Evaluation:
        training = self.training
        learner = training.learner
        suite = training.suite.at(training.steps)
        agent = Agent(learner.acting_network, suite, self.config, learner.device, training.steps)
        protocol = EvaluationProtocol.of(settings, self.config.tasks, agent.step)
        self._note(f"evaluating: {protocol}")
        known = RandomPlay(self.folder.path, self.config, suite, protocol)
        evaluation = evaluate_agent(agent, protocol, note=self._note, stop=stop, random_play=known)
        self.folder.evaluations.save(evaluation)
        self.best.at_evaluation(evaluation, agent.network)
        return evaluation

    def _note(self, text: str) -> None:
        for observer in self.observers:
            observer.note(text)
