"""Policies asked again at the episode ends of finished runs: a run's own policy says what it said."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import torch

from switchmt_snn.cli import main
from switchmt_snn.config import POLICIES, ExperimentConfig
from switchmt_snn.errors import ConfigError, RunFolderError
from switchmt_snn.learning.events import SwitchDecided
from switchmt_snn.learning.switching import EpisodeRecord, Stay, SwitchTo
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.history import read_history
from switchmt_snn.runs.logs import RunLogs
from switchmt_snn.study.replayed import Replay, csv_text, replay_policies, summary
from switchmt_snn.study.visits import recorded_visits
from tests.conftest import small_config, vector_suite

RESULTS = Path(__file__).parents[2] / "results" / "minatar"
GIVEN = {"reference_scores": (10.0, 12.0, 14.0), "floor_scores": (0.0, 0.0, 0.0)}
QUICK = {
    "visit_episodes": 4,
    "visit_steps": 30,
    "window_episodes": 2,
    "change_rate_fraction": 0.9,
    "probe_observations": 4,
    "progress_window_steps": 80,
    "check_every_steps": 120,
    "check_episodes": 2,
    "plateau_window_episodes": 4,
    "plateau_patience_episodes": 1,
    "score_episodes": 5,
    "judge_learning": "after_updates",
    **GIVEN,
}


class UnevenEnvironment:
    """Episodes of 3 to 9 steps whose returns rise with the copy's age and differ from task to task."""

    def __init__(self, task: int, num_envs: int) -> None:
        self.num_envs, self._task = num_envs, task
        self._seeds = np.zeros(num_envs, np.int64)
        self._steps = np.zeros(num_envs, np.int64)

    def _frames(self) -> npt.NDArray[np.float32]:
        return np.stack([self._steps / 9, (self._seeds % 7) / 7, np.full(self.num_envs, self._task)], 1).astype("f4")

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> npt.NDArray[np.float32]:
        self._seeds[env_ids], self._steps[env_ids] = seeds, 0
        return self._frames()[env_ids]

    def step(self, actions: npt.NDArray[np.int64]) -> Any:
        from switchmt_snn.tasks.suite import VectorStep

        self._steps += 1
        over = self._steps >= 3 + (self._seeds + 2 * self._task) % 7
        rewards = (actions == self._seeds % 2).astype(np.float64) + self._task
        return VectorStep(self._frames(), rewards, over, np.zeros_like(over))

    def close(self) -> None:
        pass


def config_of(policy: str, changes: dict[str, Any]) -> ExperimentConfig:
    settings = {"max_stay_steps": None, **QUICK, "policy": policy}
    sections = {name: value for name, value in changes.items() if name in ("learning", "tasks")}
    settings |= {name: value for name, value in changes.items() if name not in sections}
    learning = {"update_every_steps": 8, "epsilon_decay_steps": 400, "batch_size": 4} | sections.get("learning", {})
    tasks = {"names": ["a", "b", "c"], "num_envs": 2} | sections.get("tasks", {})
    return small_config(total_steps=480, switching=settings, learning=learning, tasks=tasks)


def trained(folder: Path, config: ExperimentConfig) -> tuple[Path, list[SwitchDecided], list[EpisodeRecord]]:
    """A run folder with the logs of a training, its decisions, and every record that its policy was given."""
    run = RunFolder(folder)
    run.create(config, {"program": "switchmt-snn"}, config)
    suite = vector_suite(UnevenEnvironment, 3, num_tasks=len(config.tasks.names))
    training = Training(config, suite, torch.device("cpu"))
    seen: list[EpisodeRecord] = []
    judge = training.policy.judge

    def spied(record: EpisodeRecord, left: bool = False) -> Stay | SwitchTo:
        seen.append(record)
        return judge(record, left)

    training.policy.judge = spied  # type: ignore[method-assign]
    logs = RunLogs(folder, config.tasks.names, training.policy.columns, None)
    decided = []
    for event in training.events():
        logs(event)
        if isinstance(event, SwitchDecided):
            decided.append(event)
    logs.close()
    return folder, decided, seen


FREE = "switching.max_stay_steps=null"
BOUNDS: list[dict[str, Any]] = [
    {},
    {"max_stay_steps": 61, "min_stay_episodes": 3, "tasks": {"num_envs": 4}},
    {"judge_learning": "always", "learning": {"update_tasks": "all"}, "max_stay_steps": 90},
]


@pytest.mark.parametrize("policy", POLICIES)
@pytest.mark.parametrize(
    "changes",
    [pytest.param(BOUNDS[0], marks=pytest.mark.slow), BOUNDS[1], pytest.param(BOUNDS[2], marks=pytest.mark.slow)],
)
def test_a_runs_own_policy_says_what_it_said(policy: str, changes: dict[str, Any], tmp_path: Path) -> None:
    run, decided, _ = trained(tmp_path / "run", config_of(policy, changes))
    replayed = replay_policies(RunFolder(run), [policy])
    said = {row.visit: row for row in replayed.rows}
    switches = [one for one in decided if isinstance(one.decision, SwitchTo)]
    assert len(switches) > 1
    for one in switches:
        row = said.pop(one.visit)
        assert (row.compared, row.step, row.steps_at, row.reason) == (
            "same",
            one.step,
            one.steps_in_visit,
            one.decision.reason,
        )
        assert row.next_task == "abc"[one.decision.task]  # type: ignore[union-attr]
        assert row.numbers == one.decision.measured
    assert {row.compared for row in said.values()} <= {"open"}


@pytest.mark.slow
@pytest.mark.parametrize(
    "learning",
    [
        {},
        {"update_every_steps": 7, "updates_per_round": 2, "learning_starts_steps": 70},
        {"update_tasks": "all", "update_every_steps": 5, "learning_starts_steps": 97},
        {"overlap": True, "update_every_steps": 6, "learning_starts_steps": 44},
    ],
)
def test_updates_in_a_visit_are_those_of_the_training(learning: dict[str, Any], tmp_path: Path) -> None:
    config = config_of("fixed_episodes", {"learning": learning, "max_stay_steps": 40})
    run, _, seen = trained(tmp_path / "run", config)
    visits = recorded_visits(read_history(run, config.tasks.names), config)
    ends = [end for visit in visits for end in visit.ends]
    assert [end.updates_in_visit for end in ends] == [one.updates_in_visit for one in seen]
    assert [end.steps_in_visit for end in ends] == [one.steps_in_visit for one in seen]
    assert [end.episode.episode_return for end in ends] == [one.episode_return for one in seen]
    assert len({end.updates_in_visit for end in ends}) > 2


def replayed_minatar(*overrides: str, policies: tuple[str, ...] = ()) -> Replay:
    return replay_policies(RunFolder(RESULTS / "switchmt-seed1"), policies, overrides)


@pytest.mark.slow
def test_a_stored_run_of_minatar_says_what_it_said() -> None:
    """915 visits of 600,000 steps, written by an older version."""
    replayed = replayed_minatar(policies=("parameter_change",))
    with (RESULTS / "switchmt-seed1" / "switches.csv").open() as stream:
        switches = [row for row in csv.DictReader(stream) if row["decision"] == "switch"]
    said = [row for row in replayed.rows if row.compared == "same"]
    assert [(row.step, row.reason, row.next_task) for row in said] == [
        (int(row["step"]), row["reason"], row["next_task"]) for row in switches
    ]
    assert len(said) == 915 - (len(replayed.rows) - len(said))


def by_hand(leaves: Callable[[dict[str, str]], bool]) -> dict[int, int]:
    """Steps of each visit of that run at the first row for which a rule holds, by the file alone."""
    first: dict[int, int] = {}
    with (RESULTS / "switchmt-seed1" / "switches.csv").open() as stream:
        for row in csv.DictReader(stream):
            if leaves(row):
                first.setdefault(int(row["visit"]), int(row["steps_in_visit"]))
    return first


@pytest.mark.slow
def test_other_thresholds_and_policies_are_those_of_the_file() -> None:
    free = ("switching.min_stay_steps=0", "switching.max_stay_steps=null")
    fixed = replayed_minatar(*free, "switching.visit_episodes=31", policies=("fixed_episodes",))
    expected = by_hand(lambda row: row["decision"] == "stay" and int(row["episodes_in_visit"]) >= 31)
    expected |= by_hand(lambda row: int(row["episodes_in_visit"]) == 31)
    assert {row.visit: row.steps_at for row in fixed.rows if row.steps_at is not None} == expected
    lower = replayed_minatar(*free, "switching.change_threshold=0.01", policies=("parameter_change",))
    small = by_hand(lambda row: row["parameter_change"] != "" and float(row["parameter_change"]) < 0.01)
    steps = {row.visit: row.steps_at for row in lower.rows if row.steps_at is not None}
    # The run judged from its first episode end on, also without an update (judge_learning of its time: always).
    assert steps == small
    assert 0 < len(steps) < len(lower.rows)
    facts = summary(lower, "parameter_change")
    assert facts["earlier"] + facts["same"] + facts["later"] + facts["open"] == facts["visits"] == len(lower.rows)
    ordered = sorted([row.steps_at or 10**9 for row in lower.rows])
    assert facts["median_steps"] == ordered[(len(ordered) - 1) // 2] or ordered[(len(ordered) - 1) // 2] == 10**9


@pytest.mark.slow
def test_a_visit_may_be_left_earlier_at_the_same_step_later_or_stay_open(tmp_path: Path) -> None:
    run, decided, _ = trained(tmp_path / "run", config_of("fixed_episodes", {"visit_episodes": 6}))
    whole = [one.visit for one in decided if isinstance(one.decision, SwitchTo)]
    for count, compared in ((2, "earlier"), (6, "same"), (12, "later")):
        overrides = [f"switching.visit_episodes={count}"]
        rows = replay_policies(RunFolder(run), ["fixed_episodes"], overrides).rows
        assert [row.visit for row in rows if row.compared == compared] == whole or rows[-1].compared == "earlier"
        assert {row.compared for row in rows if row.visit in whole} == {compared}
        assert {row.episodes_at for row in rows if row.visit in whole} == ({count} if count < 12 else {None})


@pytest.mark.slow
def test_what_the_logs_cannot_answer_is_refused_by_name(tmp_path: Path) -> None:
    run, _, _ = trained(tmp_path / "run", config_of("fixed_episodes", {}))
    replayed = replay_policies(RunFolder(run))
    assert set(replayed.refused) == {
        "parameter_change",
        "parameter_change_per_update",
        "parameter_and_reward",
        "value_change",
        "dormancy_guard",
    }
    with pytest.raises(ConfigError, match=r"value_change cannot be replayed .* has no value_change .* fixed_episodes"):
        replay_policies(RunFolder(run), ["value_change"])
    with pytest.raises(ConfigError, match=r"--set has learning.batch_size, expected a threshold under switching"):
        replay_policies(RunFolder(run), [], ["learning.batch_size=3"])
    with pytest.raises(ConfigError, match=r"switching.plateau_t is -1"):
        replay_policies(RunFolder(run), [], ["switching.plateau_t=-1"])
    with pytest.raises(ConfigError, match="rewards_plateau"):
        replay_policies(RunFolder(run), ["rewards_plateau"])
    measured, _, _ = trained(tmp_path / "measured", config_of("parameter_change", {}))
    with pytest.raises(ConfigError, match=r"switching.window_episodes is 3, but the run measured .* with 2"):
        replay_policies(RunFolder(measured), ["parameter_change_per_update"], ["switching.window_episodes=3"])
    single = config_of("fixed_episodes", {"tasks": {"names": ["a"]}, "reference_scores": (), "floor_scores": ()})
    with pytest.raises(ConfigError, match="has the one task a, expected a run of several"):
        replay_policies(RunFolder(trained(tmp_path / "single", single)[0]))


@pytest.mark.slow
def test_eq_3_per_update_is_replayed_from_eq_3(tmp_path: Path) -> None:
    run, _, _ = trained(
        tmp_path / "run", config_of("parameter_change", {"change_threshold": 1e-4, "max_stay_steps": 90})
    )
    rows = replay_policies(
        RunFolder(run), ["parameter_change_per_update"], ["switching.change_rate_fraction=0.9", FREE]
    ).rows
    with (run / "switches.csv").open() as stream:
        changes = {(int(row["visit"]), int(row["step"])): row["parameter_change"] for row in csv.DictReader(stream)}
    decided = [row for row in rows if row.step is not None]
    assert decided
    for row in decided:
        assert row.numbers["parameter_change"] == float(changes[row.visit, row.step or 0])
        assert row.numbers["change_per_update"] < row.numbers["largest_change_per_update"] * 0.9


@pytest.mark.slow
def test_logs_that_contradict_each_other_are_refused(tmp_path: Path) -> None:
    run, _, _ = trained(tmp_path / "run", config_of("fixed_episodes", {}))
    lines = (run / "episodes.csv").read_text().splitlines(keepends=True)
    (run / "episodes.csv").write_text("".join(lines[:3] + lines[5:]))
    with pytest.raises(RunFolderError, match=r"switches.csv has at step \d+ .* expected one row in it for each row"):
        replay_policies(RunFolder(run))


@pytest.mark.slow
def test_a_visit_that_goes_on_after_the_switch_is_seen_but_not_left_again(tmp_path: Path) -> None:
    """The next task is chosen once per visit, as the contract of ``Criterion.next_task`` says."""
    run, _, _ = trained(tmp_path / "run", config_of("fixed_episodes", {"visit_episodes": 12}))
    counted: list[int] = []
    from switchmt_snn.learning.switching.deficit import Deficit

    with pytest.MonkeyPatch.context() as patch:
        choose = Deficit.next_task

        def spied(self: Deficit, task: int, num_tasks: int, steps_in_visit: int) -> int:
            counted.append(steps_in_visit)
            return choose(self, task, num_tasks, steps_in_visit)

        patch.setattr(Deficit, "next_task", spied)
        rows = replay_policies(RunFolder(run), ["deficit"], ["switching.visit_steps=10"]).rows
    assert {row.compared for row in rows[:-1]} >= {"earlier"}
    assert len(counted) == sum(row.compared != "open" for row in rows)


@pytest.mark.slow
def test_the_command_prints_a_table_json_and_a_csv(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "200")  # no cell is wrapped
    run, _, _ = trained(tmp_path / "run", config_of("reward_plateau", {}))
    out = tmp_path / "rows.csv"
    with pytest.raises(SystemExit) as stop:
        main(["replay-policies", str(run), "--policy", "interleave", "fixed_steps", "--out", str(out), "--json"])
    assert stop.value.code == 0
    facts = json.loads(capsys.readouterr().out)
    assert [row["policy"] for row in facts["policies"]] == ["interleave", "fixed_steps"]
    assert "is not known" in facts["meaning"].replace("\n", " ")
    with out.open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == len(facts["visits"]) == sum(one["visits"] for one in facts["policies"])
    assert {row["policy"]: row["episodes_at"] for row in rows if row["visit"] == "1"}["interleave"] == "1"
    assert out.read_text() == csv_text(replay_policies(RunFolder(run), ["interleave", "fixed_steps"]))
    for words, code, said in (
        ([], 0, "reward_plateau (the run's)"),
        (["--out", str(tmp_path / "none" / "rows.csv")], 2, "cannot be written"),
        (["--policy", "value_change"], 2, "has no value_change"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["replay-policies", str(run), *words])
        printed = capsys.readouterr()
        assert stop.value.code == code
        assert said in " ".join((printed.out + printed.err).split())


@pytest.mark.slow
def test_a_run_from_before_judge_learning_is_asked_as_it_was(tmp_path: Path) -> None:
    config = config_of("parameter_change", {"judge_learning": "always"})
    run, decided, _ = trained(tmp_path / "run", config)
    older = replace(config, switching=replace(config.switching, judge_learning="auto"))
    RunFolder(tmp_path / "older").create(older, {"program": "switchmt-snn"}, older)
    for name in ("episodes.csv", "switches.csv", "metrics.jsonl"):
        (tmp_path / "older" / name).write_bytes((run / name).read_bytes())
    rows = replay_policies(RunFolder(tmp_path / "older"), ["parameter_change"]).rows
    assert [row.step for row in rows if row.compared == "same"] == [
        one.step for one in decided if isinstance(one.decision, SwitchTo)
    ]
