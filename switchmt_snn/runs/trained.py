"""The trained agent of a run, and what it scores; for the command line and the library."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol, evaluate_agent
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.machine.devices import select_device
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.runs.checkpoint import fitting_weights
from switchmt_snn.runs.fresh_statistics import with_fresh_statistics
from switchmt_snn.runs.packing import open_run
from switchmt_snn.runs.random_play import RandomPlay
from switchmt_snn.spiking.network import build_network
from switchmt_snn.tasks.registry import make_suite


def load_agent(
    run: str | Path | None = None,
    checkpoint: str = "last",
    device: str = "auto",
    threads: int | None = None,
    trust: bool = False,
) -> Agent:
    """The trained agent of a run.

    Args:
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
        checkpoint: ``last`` or ``best``.
        device: as in the config.
        threads: CPU threads of PyTorch, for the whole process; None leaves them. With more than one a decision may be
            faster, and sums may have another order.
        trust: let modules that the run names be imported although this user did not make it (SECURITY.md).

    Raises:
        RunFolderError: no such run.
        CheckpointError: no whole checkpoint.

    Examples:
        A loop of one's own; ``Agent.environment`` plays a task exactly as training does.

        >>> from switchmt_snn import load_agent
        >>> agent = load_agent("runs/mine")  # the run of train's example
        >>> env = agent.environment("CartPole-v1")
        >>> observation, _ = env.reset(seed=1)
        >>> terminated = truncated = False
        >>> while not (terminated or truncated):
        ...     observation, reward, terminated, truncated, _ = env.step(agent.act(observation, "CartPole-v1"))
    """
    if threads is not None:
        torch.set_num_threads(threads)
    folder = open_run(run, trust=trust)
    config = folder.config()
    suite = make_suite(config.tasks)
    with as_when_started():
        step, weights = folder.checkpoints().load_model(checkpoint)
        network = build_network(config.network, observation_spec(suite), config.seed)
        with fitting_weights():
            network.load_state_dict(weights)
        return Agent(network, suite.at(step), config, select_device(device), step)


@as_when_started()
def evaluate(
    run: str | Path | None = None,
    task: str | None = None,
    checkpoint: str = "last",
    save: bool = True,
    note: Callable[[str], None] | None = None,
    reestimate_batches: int = 0,
    trust: bool = False,
    **protocol: Any,
) -> Evaluation:
    """Evaluate a run's agent and the random policy.

    Args:
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
        task: one task's name; None evaluates all.
        checkpoint: ``last`` or ``best``.
        save: write JSON and CSV to the run's ``evaluations/``.
        note: receives what the user should know meanwhile: episodes that do not end.
        reestimate_batches: re-estimate the normalisation statistics from so many batches of each task's replay; the
            files then go to ``evaluations/reestimated/``. 0 takes the stored ones.
        trust: as for ``load_agent``.
        protocol: fields of EvaluationConfig to change (``episodes=5``); the rest is the run's.

    Raises:
        SwitchMTError: no run, checkpoint or task of that name, a protocol out of range, no replay to estimate from.
    """
    folder = open_run(run, trust=trust)
    agent = load_agent(folder.path, checkpoint)
    if reestimate_batches != 0:
        agent = with_fresh_statistics(agent, folder, reestimate_batches)
    settings = replace(agent.config.evaluation, **protocol)
    tasks = None if task is None else (agent.suite.names[agent.suite.index(task)],)
    conditions = EvaluationProtocol.of(settings, agent.config.tasks, agent.step)
    conditions = replace(conditions, statistics_batches=reestimate_batches)
    folder = open_run(folder.path, to_write=save)
    known = RandomPlay(folder.path, agent.config, agent.suite, conditions) if save else None
    evaluation = evaluate_agent(agent, conditions, tasks, note, random_play=known)
    if save:
        (folder.reestimated_evaluations if reestimate_batches else folder.evaluations).save(evaluation)
    return evaluation
