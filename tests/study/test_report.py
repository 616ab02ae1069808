"""A study's tables: numbers recomputed from the CSV files and the run folders, and the page."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from switchmt_snn.config import to_yaml
from switchmt_snn.errors import RunFolderError
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.study import statistics
from switchmt_snn.study.folder import StudyFolder
from switchmt_snn.study.grid import Study, Trial
from switchmt_snn.study.report import write_study_report
from switchmt_snn.study.results import read_results
from tests.pages import assert_sound
from tests.viewing.test_run_report import Page

RESULTS = Path(__file__).parents[2] / "results" / "minatar"
VARIANTS = {"switchmt": "switchmt", "bfloat16": "bf16"}
GAMES = ("breakout", "asterix", "space_invaders")


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[Study, StudyFolder]:
    """Six stored MinAtar runs as a study: two variants, three seeds, and a seventh trial that has not begun."""
    folder = StudyFolder(tmp_path_factory.mktemp("studies") / "minatar")
    trials = []
    for seed in (1, 2, 3):
        for variant, stored in VARIANTS.items():
            config = RunFolder(RESULTS / f"{stored}-seed{seed}").config()
            trials.append(Trial(f"{variant}_seed{seed}", variant, seed, config))
    trials.append(Trial("switchmt_seed4", "switchmt", 4, trials[0].config))
    study = Study("minatar", tuple(trials), {"breakout": 6.0, "asterix": 2.0, "space_invaders": "bfloat16"}, "switchmt")
    folder.prepare(study)
    for trial in trials[:-1]:
        stored = RESULTS / f"{VARIANTS[trial.variant]}-seed{trial.seed}"
        shutil.copytree(stored, folder.run(trial), dirs_exist_ok=True)
        if trial.seed > 1:
            continue  # its checkpoints were left out
        (folder.run(trial) / "checkpoints" / f"step-{trial.config.total_steps:012d}").mkdir(parents=True, exist_ok=True)
    assert write_study_report(study, folder) == folder.path / "report.html"
    return study, folder


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


def table(folder: StudyFolder, name: str) -> dict[str, dict[str, Any]]:
    facts = json.loads((folder.path / "study.json").read_text())
    (found,) = (one for one in facts["tables"] if one["name"] == name)
    return {row["variant"]: row for row in found["rows"]}


@pytest.mark.slow
def test_scores_are_those_of_the_final_evaluations(finished: tuple[Study, StudyFolder]) -> None:
    _, folder = finished
    rows = rows_of(folder.path / "scores.csv")
    assert len(rows) == 6 * 3
    for row in rows:
        stored = RESULTS / f"{VARIANTS[row['variant']]}-seed{row['seed']}" / "evaluations"
        found = [json.loads(path.read_text()) for path in stored.glob("*.json")]
        means = {
            one["mean"]
            for each in found
            for one in each["tasks"]
            if (one["task"], one["policy"]) == (row["task"], "agent")
        }
        assert float(row["mean"]) in means
    shown = table(folder, "scores")
    for variant in VARIANTS:
        for game in GAMES:
            scores = [float(row["mean"]) for row in rows if (row["variant"], row["task"]) == (variant, game)]
            assert shown[variant][game]["value"] == pytest.approx(np.mean(scores))
            assert min(scores) <= shown[variant][game]["low"] <= shown[variant][game]["high"] <= max(scores)


def test_steps_of_the_tasks_add_up_to_the_run(finished: tuple[Study, StudyFolder]) -> None:
    study, folder = finished
    rows, trials = rows_of(folder.path / "scores.csv"), rows_of(folder.path / "trials.csv")
    for one in trials:
        own = [row for row in rows if row["trial"] == one["trial"]]
        assert sum(int(row["steps"]) for row in own) == int(one["step"]) == 600_000
        assert sum(int(row["updates"]) for row in own) == int(one["updates"])
        assert sum(int(row["visits"]) for row in own) == int(one["switches"]) + 1
        with (folder.run(next(t for t in study.trials if t.name == one["trial"])) / "metrics.jsonl").open() as stream:
            measured = json.loads(stream.readlines()[-1])
        if measured["step"] == 600_000:
            assert {row["task"]: int(row["steps"]) for row in own} == measured["steps_by_task"]


def test_shares_and_comparisons_are_those_of_the_statistics(finished: tuple[Study, StudyFolder]) -> None:
    _, folder = finished
    rows = rows_of(folder.path / "scores.csv")
    scores = {
        variant: np.asarray(
            [
                [
                    float(r["mean"])
                    for g in GAMES
                    for r in rows
                    if (r["variant"], r["seed"], r["task"]) == (variant, str(s), g)
                ]
                for s in (1, 2, 3)
            ]
        )
        for variant in VARIANTS
    }
    references = [6.0, 2.0, scores["bfloat16"][:, 2].mean()]
    shown = table(folder, "shares")
    harmonic = {}
    for variant, values in scores.items():
        shares = np.minimum(values / references, 1.0)
        harmonic[variant] = 3 / (1 / shares).sum(axis=1)
        assert shown[variant]["harmonic mean"]["value"] == pytest.approx(harmonic[variant].mean())
        assert shown[variant]["minimum"]["value"] == pytest.approx(shares.min(axis=1).mean())
        assert shown[variant]["IQM"]["value"] == pytest.approx(np.sort(shares.ravel())[2:7].mean())
    wins = np.mean([[(a > b) + 0.5 * (a == b) for b in harmonic["switchmt"]] for a in harmonic["bfloat16"]])
    assert shown["bfloat16"]["P(> switchmt)"]["value"] == pytest.approx(wins)
    assert shown["bfloat16"]["p"] == pytest.approx(
        statistics.sign_flip_test(list(harmonic["bfloat16"] - harmonic["switchmt"]))
    )
    assert shown["switchmt"]["p"] is None


@pytest.mark.slow
def test_tables_and_page_say_what_is_missing_and_the_same_numbers(finished: tuple[Study, StudyFolder]) -> None:
    study, folder = finished
    text = (folder.path / "tables.md").read_text()
    headline = "6 of 7 trials finished. Not finished: switchmt_seed4."
    assert text.startswith(f"# Study minatar\n\n{headline}\n")
    lines = [line for line in text.splitlines() if line.startswith("| ")]
    assert len({line.count("|") for line in lines if "switches" not in line}) >= 1
    page = Page((folder.path / "report.html").read_text(encoding="utf-8"))
    assert not [one for one in page.addresses if not one.startswith(("#", "data:"))]
    shown = " ".join(page.text)
    assert headline in " ".join(shown.split())
    for line in lines:
        for cell in line.strip("| ").split(" | "):
            assert cell.strip(" |").replace("\\|", "|") in shown
    for name in ("comparison_1.svg", "comparison_1.png", "comparison_1.csv"):
        assert (folder.path / "report_figures" / name).stat().st_size > 100
    before = {
        name: (folder.path / name).read_bytes() for name in ("tables.md", "study.json", "scores.csv", "curves.csv")
    }
    write_study_report(study, folder)
    assert before == {name: (folder.path / name).read_bytes() for name in before}


@pytest.mark.parametrize(
    ("name", "change"),
    [("later", {"max_episode_steps": 50}), ("zlater", {"num_envs": 3}), ("zlater", {"epsilon": 0.9})],
)
def test_an_evaluation_that_was_played_otherwise_counts_for_nothing(
    name: str, change: dict[str, Any], finished: tuple[Study, StudyFolder], tmp_path: Path
) -> None:
    study, folder = finished
    copy = StudyFolder(tmp_path / "copy")
    shutil.copytree(folder.path, copy.path)
    for trial in study.trials[:-1]:
        evaluations = copy.run(trial) / "evaluations"
        for path in list(evaluations.glob("step-*.json")):
            stored = json.loads(path.read_text())
            stored["protocol"] |= change
            for row in stored["tasks"]:
                row["mean"] = 0.0
            path.with_name(f"{path.stem}_{name}.json").write_text(json.dumps(stored))
    write_study_report(study, copy)
    for name in ("tables.md", "scores.csv", "curves.csv"):
        assert (copy.path / name).read_text() == (folder.path / name).read_text()


@pytest.mark.slow
def test_the_page_is_sound_in_a_browser(finished: tuple[Study, StudyFolder]) -> None:
    assert_sound(finished[1].path / "report.html")


def test_a_study_without_a_finished_trial_has_no_report(tmp_path: Path) -> None:
    config = RunFolder(RESULTS / "switchmt-seed1").config()
    study, folder = Study("empty", (Trial("a_seed1", "a", 1, config),), {}, "a"), StudyFolder(tmp_path / "s")
    folder.prepare(study)
    assert read_results(study, folder) == []
    with pytest.raises(RunFolderError, match=r"no trial of .* has finished, expected one"):
        write_study_report(study, folder)
    assert to_yaml(config)
