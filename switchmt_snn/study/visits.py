"""The visits of a finished run, as its logs tell them: what a switching policy could see at every episode's end."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import RunFolderError
from switchmt_snn.learning.events import EpisodeEnded
from switchmt_snn.runs.history import Decision, History


@dataclass(frozen=True)
class RecordedEnd:
    """An episode's end: its row in episodes.csv, and what was decided there.

    Attributes:
        updates_in_visit: gradient steps from the task's own replay since the task was entered.
    """

    episode: EpisodeEnded
    decision: Decision
    episodes_in_visit: int
    steps_in_visit: int
    updates_in_visit: int


@dataclass
class RecordedVisit:
    """A stay on a task.

    Attributes:
        number: as in switches.csv, from 1.
        task: index.
        begin_step: of the run.
        ends: every episode that ended in it.
        left_by: the decision that ended it, at an episode's end or within an episode; None for a visit that went on
            when the run ended.
        steps: agent steps of the visit.
    """

    number: int
    task: int
    begin_step: int
    ends: list[RecordedEnd] = field(default_factory=list)
    left_by: Decision | None = None
    steps: int = 0


def recorded_visits(history: History, config: ExperimentConfig) -> list[RecordedVisit]:
    """The visits of a run, in order; the last one may go on.

    Args:
        history: the run's logs.
        config: the run's, decided.

    Raises:
        RunFolderError: episodes.csv and switches.csv do not tell of the same episodes.
    """
    visits: list[RecordedVisit] = []
    own_steps = [0] * len(history.task_names)
    before = 0  # the task's steps before the visit
    episodes = iter(history.episodes)
    for decision in history.decisions:
        if not visits or decision.visit != visits[-1].number:
            begin = visits[-1].begin_step + visits[-1].steps if visits else 0
            visits.append(RecordedVisit(decision.visit, history.task_names.index(decision.task), begin))
            before = own_steps[visits[-1].task]
        visit = visits[-1]
        counted, steps = int(decision.numbers["episodes_in_visit"]), int(decision.numbers["steps_in_visit"])
        if counted == len(visit.ends) + 1:
            left = visits[-2].left_by if len(visits) > 1 else None
            episode = _next_episode(episodes, decision, left)
            updates = _updates_in_visit(config, visit.begin_step, visit.begin_step + steps, before)
            visit.ends.append(RecordedEnd(episode, decision, counted, steps, updates))
        elif counted != len(visit.ends):
            raise _torn(decision, f"episode {counted} of visit {visit.number} after episode {len(visit.ends)}")
        visit.steps = steps
        if decision.switches:
            visit.left_by = decision
            own_steps[visit.task] += steps
    _add_unfinished(visits, history)
    return visits


def _next_episode(episodes: Iterator[EpisodeEnded], decision: Decision, left: Decision | None) -> EpisodeEnded:
    """The episode of a decision; older versions decided nothing for those that ended with one that ended the visit."""
    episode = next(episodes, None)
    while episode is not None and left is not None and episode.step == left.step < decision.step:
        episode = next(episodes, None)
    if episode is None or episode.step != decision.step:
        found = "no more" if episode is None else f"one at step {episode.step}"
        raise _torn(decision, f"an episode of {decision.task} where episodes.csv has {found}")
    return episode


def _torn(decision: Decision, seen: str) -> RunFolderError:
    return RunFolderError(
        f"switches.csv has at step {decision.step} {seen}, expected one row in it for each row of episodes.csv, in the "
        "same order; restore both files from a copy"
    )


def _add_unfinished(visits: list[RecordedVisit], history: History) -> None:
    """A visit that was left is over; the run's newest step belongs to the one that follows."""
    if visits and visits[-1].left_by is None:
        visits[-1].steps = max(visits[-1].steps, history.last_step - visits[-1].begin_step)


def _updates_in_visit(config: ExperimentConfig, begin_step: int, step: int, own_steps_before: int) -> int:
    """Gradient steps from the task's own replay in a visit, up to a step; no log counts them by task.

    Updates come every ``learning.update_every_steps`` of the run, once the task has played
    ``learning.learning_starts_steps`` (with ``learning.overlap``: by the step before).

    Args:
        own_steps_before: steps of the task before the visit.
    """
    learning, copies = config.learning, config.tasks.num_envs
    missing = max(learning.learning_starts_steps - own_steps_before, 0) + (copies if learning.overlap else 0)
    first = begin_step + max(-(-missing // copies), 1) * copies  # the step after which the first one is possible
    if step < first:
        return 0
    rounds = step // learning.update_every_steps - (first - copies) // learning.update_every_steps
    return rounds * learning.updates_per_round
