"""What the trials of a study came to, read from their run folders: the rows of tables, CSV files and statistics.

Nothing here depends on time or machine: a study that was interrupted gives the same rows.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from switchmt_snn.acting.evaluation import EvaluationProtocol
from switchmt_snn.runs.evaluations import played_as
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.study.folder import StudyFolder, TrialRun
from switchmt_snn.study.grid import Study, Trial
from switchmt_snn.viewing.report.sources import Sources, read_sources
from switchmt_snn.viewing.report.switching import visits


@dataclass(frozen=True)
class TaskResult:
    """One task of one finished trial.

    Attributes:
        mean: raw return of the agent in the final evaluation; ``random_mean`` that of random play in the same.
        standard_error: over its episodes; None with one episode.
        steps: agent steps in the task.
        updates: gradient steps of the run while the task was played. With ``learning.update_tasks: all`` all tasks
            share them.
        visits: how often the task was entered.
        curve: step and mean return of the evaluations during training, and last of the final one.
        reestimated: as ``mean``, with re-estimated normalisation statistics; None if that was not evaluated.
    """

    trial: str
    variant: str
    seed: int
    task: str
    mean: float
    standard_error: float | None
    random_mean: float | None
    episodes: int
    steps: int
    updates: int
    visits: int
    curve: tuple[tuple[int, float], ...]
    reestimated: float | None


@dataclass(frozen=True)
class TrialResult:
    """One finished trial.

    Attributes:
        step: at which it ended.
        updates: gradient steps of the run.
        switches: how often it went to another task.
        protocol: of the final evaluation, in words.
        run: all that was read of it.
    """

    trial: Trial
    step: int
    updates: int
    switches: int
    protocol: str
    tasks: tuple[TaskResult, ...]
    run: Sources = field(repr=False, compare=False)


def read_results(study: Study, folder: StudyFolder) -> list[TrialResult]:
    """The finished trials, in the study's order.

    Raises:
        RunFolderError: a log of a finished trial cannot be read.
    """
    found = []
    for trial in study.trials:
        final = TrialRun(folder.run(trial)).final
        if final is not None:
            path = folder.run(trial)
            fresh = _reestimated(RunFolder(path).reestimated_evaluations.all(), final)
            found.append(_result(trial, read_sources(path), final, fresh))
    return found


def _result(trial: Trial, run: Sources, final: dict[str, Any], fresh: dict[str, float]) -> TrialResult:
    stays = visits(run)
    counted = [(one.step, one.updates) for one in run.history.episodes]
    counted = sorted({*counted, *((one.step, one.updates) for one in run.history.measured)})
    rows = {(row["task"], row["policy"]): row for row in final["tasks"]}
    tasks = []
    for index, task in enumerate(run.tasks):
        own = [visit for visit in stays if visit.task == index]
        agent, random = rows[task, "agent"], rows.get((task, "random"))
        error = agent.get("standard_error")
        tasks.append(
            TaskResult(
                trial=trial.name,
                variant=trial.variant,
                seed=trial.seed,
                task=task,
                mean=agent["mean"],
                standard_error=None if error is None else float(error),
                random_mean=None if random is None else random["mean"],
                episodes=int(agent["episodes"]),
                steps=sum(visit.end - visit.begin for visit in own),
                updates=sum(_updates_at(counted, visit.end) - _updates_at(counted, visit.begin) for visit in own),
                visits=len(own),
                curve=_curve(run, final, task),
                reestimated=fresh.get(task),
            )
        )
    return TrialResult(
        trial=trial,
        step=int(final["step"]),
        updates=run.history.updates,
        switches=len(stays) - 1,
        protocol=str(EvaluationProtocol.from_dict(final["protocol"])),
        tasks=tuple(tasks),
        run=run,
    )


def _updates_at(counted: Sequence[tuple[int, int]], step: int) -> int:
    """Updates that the newest log line up to a step names."""
    place = bisect_right(counted, step, key=lambda one: one[0])
    return counted[place - 1][1] if place else 0


def _curve(run: Sources, final: dict[str, Any], task: str) -> tuple[tuple[int, float], ...]:
    """Evaluations during training, and the final one."""
    points = {}
    for one in played_as(run.evaluations, run.config.evaluation):
        mean = _mean(one, task)
        if mean is not None and one["step"] < final["step"]:
            points[int(one["step"])] = mean
    last = _mean(final, task)
    return tuple(sorted(points.items())) + (() if last is None else ((int(final["step"]), last),))


def _reestimated(evaluations: Sequence[dict[str, Any]], final: dict[str, Any]) -> dict[str, float]:
    """Mean return by task with re-estimated statistics, in evaluations with the final one's step, episodes and seed.

    Of several, the one of most batches counts.
    """
    keys = ("episodes", "epsilon", "seed", "max_episode_steps")
    found: dict[str, float] = {}
    for one in sorted(evaluations, key=lambda one: int(one["protocol"].get("statistics_batches", 0))):
        same = all(one["protocol"].get(key) == final["protocol"].get(key) for key in keys)
        if same and one["step"] == final["step"]:
            found |= {row["task"]: float(row["mean"]) for row in one["tasks"] if row["policy"] == "agent"}
    return found


def _mean(evaluation: dict[str, Any], task: str) -> float | None:
    means = [row["mean"] for row in evaluation["tasks"] if (row["policy"], row["task"]) == ("agent", task)]
    return float(means[0]) if means else None
