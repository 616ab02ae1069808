"""What other switching policies would have said at the episode ends of a finished run.

After the first switch that differs, another policy would have collected other data, so a finished run cannot tell what
would have followed. It can tell, for each visit that really happened, at which episode end of it a policy would have
said "switch". That is all that is computed here, by the policies' own code.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from statistics import median_low
from typing import Any, Literal

from rich.table import Table
from rich.text import Text
from torch import Tensor

from switchmt_snn.config import POLICIES, ExperimentConfig, SwitchingConfig
from switchmt_snn.config.plugins import PluginName, is_plugin
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.learning.switching import (
    EpisodeRecord,
    Stay,
    SwitchingPolicy,
    SwitchTo,
    criterion_class,
)
from switchmt_snn.machine.progress import progress_of
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.history import policy_columns, read_history
from switchmt_snn.study.grid import override_settings, with_settings
from switchmt_snn.study.visits import RecordedEnd, RecordedVisit, recorded_visits
from switchmt_snn.tasks.registry import find_suite
from switchmt_snn.tasks.suite import Reference

Compared = Literal["earlier", "same", "later", "open"]
COMPARED: tuple[Compared, ...] = ("earlier", "same", "later", "open")
MEANING = (
    "For each visit that really happened: where in it the policy would have said switch. What would have followed is "
    "not known, because the policy would have collected other data."
)
"""What the numbers are, for help and output."""


@dataclass(frozen=True)
class Replayed:
    """What a policy would have said in a visit; a row of the CSV.

    Attributes:
        visit: number of the visit, from 1.
        task: its name.
        episodes, steps: of the visit as it was.
        left_by: the reason with which the run left it; empty for the last one, which was never left.
        policy: as ``switching.policy`` names it.
        compared: ``earlier`` or at the ``same`` step as the run; ``later``: not within the visit; ``open``: not within
            the last visit, which was never left.
        episodes_at, steps_at: of the visit, at the policy's switch; None for later and open.
        step: of the run, at that switch.
        reason: the policy's.
        next_task: where it would have gone.
        numbers: what it measured there, by column of switches.csv.
    """

    visit: int
    task: str
    episodes: int
    steps: int
    left_by: str
    policy: str
    compared: Compared
    episodes_at: int | None
    steps_at: int | None
    step: int | None
    reason: str
    next_task: str
    numbers: dict[str, float]


@dataclass(frozen=True)
class Replay:
    """What policies would have said in all visits of a run.

    Attributes:
        own: the policy with which the run was trained.
        rows: policy by policy, visit by visit.
        refused: policies that the run's logs cannot answer for, and why.
    """

    run: str
    own: str
    rows: tuple[Replayed, ...]
    refused: dict[str, str]

    @property
    def policies(self) -> tuple[str, ...]:
        """Those that were replayed, in order."""
        return tuple(dict.fromkeys(row.policy for row in self.rows))

    def to_dict(self) -> dict[str, Any]:
        """The numbers for JSON: a summary by policy, and every row."""
        return {
            "run": self.run,
            "own_policy": self.own,
            "meaning": MEANING,
            "policies": [summary(self, policy) for policy in self.policies],
            "refused": self.refused,
            "visits": [asdict(row) for row in self.rows],
        }


def replay_policies(run: RunFolder, policies: Sequence[str] = (), overrides: Sequence[str] = ()) -> Replay:
    """Ask policies at every episode end of a run.

    Args:
        run: an existing run of several tasks.
        policies: names, as ``switching.policy`` takes them; empty for all of the package and the run's own.
        overrides: ``switching.KEY=VALUE`` over the run's own settings, for every policy.

    Raises:
        ConfigError: a policy or setting that does not exist, one that was named and cannot be replayed, or a run of
            one task.
        RunFolderError: the run has no decisions, or its logs contradict each other.
    """
    config = run.config()
    if len(config.tasks.names) < 2:
        raise ConfigError(
            f"{run.path} has the one task {config.tasks.names[0]}, expected a run of several: nothing was decided in it"
        )
    history = read_history(run.path, config.tasks.names)
    visits = recorded_visits(history, config)
    if not visits:
        raise RunFolderError(f"{run.path} has no row in switches.csv, expected a run in which an episode ended")
    settings = _settings(config, overrides)
    columns = set(policy_columns(history)) | set(criterion_class(config.switching.policy).columns)
    published = find_suite(config.tasks.suite).references
    references = [published.get(name) for name in config.tasks.names]
    own = config.switching.policy
    rows: list[Replayed] = []
    refused: dict[str, str] = {}
    names = tuple(dict.fromkeys(policies or (own, *POLICIES)))
    with progress_of(f"replaying {len(visits):,} visits", len(names), "policies") as progress:
        for name in names:
            try:
                options = settings.options if name == own or is_plugin(name) else ()
                asked = replace(settings, policy=PluginName(name), options=options)  # any name; the config checks it
                _require_columns(asked, config.switching, columns)
                rows += _replay(asked, visits, config, references)
            except ConfigError as error:
                if policies:
                    raise ConfigError(f"{name} cannot be replayed on {run.path}: {error}") from error
                refused[name] = str(error)
            progress.advance()
    return Replay(str(run.path), own, tuple(rows), refused)


def summary(replayed: Replay, policy: str) -> dict[str, Any]:
    """One policy's visits in numbers.

    The medians are over all visits, one that the policy would not have left within them counting as longer than all
    others; None if that is what the median visit is.
    """
    rows = [row for row in replayed.rows if row.policy == policy]
    counts: dict[str, Any] = {name: sum(row.compared == name for row in rows) for name in COMPARED}
    medians = {
        f"median_{name}": _median([getattr(row, f"{name}_at") for row in rows]) for name in ("episodes", "steps")
    }
    return {"policy": policy, "visits": len(rows), **counts, **medians}


def replay_table(replayed: Replay) -> Table:
    """The summaries as a table, and what was refused."""
    own = [row for row in replayed.rows if row.policy == replayed.policies[0]] if replayed.rows else []
    lengths = [_median([getattr(row, name) for row in own]) for name in ("episodes", "steps")] if own else []
    said = [MEANING]
    if lengths:
        said.append(f"The run's {len(own):,} visits: median {lengths[0]:,} episodes, {lengths[1]:,} steps.")
    said.append("Medians: at the policy's switch; none if it would have stayed longer than half of the visits.")
    said += [f"Not replayed: {name}: {why}." for name, why in replayed.refused.items()]
    table = Table(
        title=f"{replayed.run}: when each policy would have left the visits of {replayed.own}",
        caption=Text("\n".join(said)),
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("policy", overflow="fold")
    for name in (*COMPARED, "median episodes", "median steps"):
        table.add_column(name, justify="right")
    for policy in replayed.policies:
        row = summary(replayed, policy)
        medians = [row[f"median_{name}"] for name in ("episodes", "steps")]
        counts = [str(row[name] or "") for name in COMPARED]
        name = f"{policy} (the run's)" if policy == replayed.own else policy
        table.add_row(name, *counts, *("" if value is None else f"{value:,}" for value in medians))
    return table


def csv_text(replayed: Replay) -> str:
    """One row per visit and policy, with a column for every number that a policy measured."""
    stream = io.StringIO()
    measured = list(dict.fromkeys(name for row in replayed.rows for name in row.numbers))
    fields = [name for name in Replayed.__dataclass_fields__ if name != "numbers"]
    writer = csv.DictWriter(stream, [*fields, *measured], restval="", lineterminator="\n")
    writer.writeheader()
    for row in replayed.rows:
        cells = {name: getattr(row, name) for name in fields}
        writer.writerow({name: "" if cell is None else cell for name, cell in cells.items()} | row.numbers)
    return stream.getvalue()


def _median(values: list[int | None]) -> int | None:
    found = median_low([math.inf if value is None else value for value in values])
    return None if found == math.inf else int(found)


def _settings(config: ExperimentConfig, overrides: Sequence[str]) -> SwitchingConfig:
    """The run's settings under ``switching`` with those of ``--set``."""
    given = override_settings(overrides, "switching.plateau_t=0.5")
    for key in given:
        if not key.startswith("switching.") or key == "switching.policy":
            raise ConfigError(f"--set has {key}, expected a threshold under switching; --policy names the policies")
    settings = with_settings(config, given, "--set").switching
    if settings.judge_learning == "auto":  # a run from before the setting
        settings = replace(settings, judge_learning="always")
    return settings


def _require_columns(asked: SwitchingConfig, trained: SwitchingConfig, columns: set[str]) -> None:
    """Refuse a policy whose numbers of the network the run did not measure, or not in the same way."""
    for column, settings in criterion_class(asked.policy).needs_network.items():
        if column not in columns:
            raise ConfigError(
                f"switches.csv has no {column} (the run's policy is {trained.policy}), expected a run whose policy "
                "measures it: it cannot be computed without the network"
            )
        for name in settings:
            was, now = getattr(trained, name), getattr(asked, name)
            if was != now:
                raise ConfigError(
                    f"switching.{name} is {now}, but the run measured {column} with {was}, expected the same; leave "
                    f"switching.{name} out of --set"
                )


def _replay(
    settings: SwitchingConfig,
    visits: list[RecordedVisit],
    config: ExperimentConfig,
    references: list[Reference | None],
) -> list[Replayed]:
    """One policy, through all visits in order: what it keeps from visit to visit is kept."""
    names = config.tasks.names
    policy = SwitchingPolicy(settings, len(names), references)
    rows = []
    for visit in visits:
        switch, counted, steps = _first_switch(policy, visit, config.tasks.num_envs)
        measured = {} if switch is None else switch.measured
        over = visit.left_by is not None
        compared: Compared = ("later" if over else "open") if switch is None else "same"
        if switch is not None and (not over or steps < visit.steps):
            compared = "earlier"
        rows.append(
            Replayed(
                visit=visit.number,
                task=names[visit.task],
                episodes=len(visit.ends),
                steps=visit.steps,
                left_by="" if visit.left_by is None else visit.left_by.reason,
                policy=settings.policy,
                compared=compared,
                episodes_at=None if switch is None else counted,
                steps_at=None if switch is None else steps,
                step=None if switch is None else visit.begin_step + steps,
                reason="" if switch is None else switch.reason,
                next_task="" if switch is None else names[switch.task],
                numbers=measured,
            )
        )
        policy.start_visit()
    return rows


def _first_switch(policy: SwitchingPolicy, visit: RecordedVisit, copies: int) -> tuple[SwitchTo | None, int, int]:
    """The policy's switch in a visit, with the episodes and steps of the visit there; None if it says none.

    It sees the episodes after its switch, too, as it sees those that end in the same step. The end of a visit that it
    would not have ended comes to it as one by ``max_stay_steps``.
    """
    longest = policy.config.max_stay_steps
    bound = math.inf if longest is None else -(-longest // copies) * copies  # the first step at which it is passed
    found: tuple[SwitchTo | None, int, int] = (None, 0, 0)
    for end in visit.ends:
        if found[0] is None and bound < end.steps_in_visit:
            found = policy.leave(visit.task, int(bound)), end.episodes_in_visit - 1, int(bound)
        decision = policy.judge(_record(visit.task, end), left=found[0] is not None)
        if not isinstance(decision, Stay):
            found = decision, end.episodes_in_visit, end.steps_in_visit
    if found[0] is None and bound <= visit.steps:
        found = policy.leave(visit.task, int(bound)), len(visit.ends), int(bound)
    if found[0] is None and visit.left_by is not None:
        policy.leave(visit.task, visit.steps)
    return found


def _record(task: int, end: RecordedEnd) -> EpisodeRecord:
    return EpisodeRecord(
        task=task,
        episodes_in_visit=end.episodes_in_visit,
        steps_in_visit=end.steps_in_visit,
        updates=end.episode.updates,
        updates_in_visit=end.updates_in_visit,
        episode_return=end.episode.episode_return,
        parameters=_no_parameters,
        recorded=end.decision.numbers,
    )


def _no_parameters() -> Tensor:
    raise ConfigError(
        "it asks for parameters, which a finished run no longer has, expected a criterion that states "
        "Criterion.needs_network and takes EpisodeRecord.recorded_number"
    )
