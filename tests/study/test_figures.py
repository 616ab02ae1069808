"""The figures of a study: their numbers are those of the statistics, recomputed here; the page and files hold them."""

from __future__ import annotations

import csv
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from switchmt_snn.drawing.chart import Chart, Timeline
from switchmt_snn.drawing.files import figure_files
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.study import report
from switchmt_snn.study.figures import THRESHOLDS, study_figures
from switchmt_snn.study.folder import StudyFolder, TrialRun
from switchmt_snn.study.grid import Study
from switchmt_snn.study.results import TrialResult, read_results
from switchmt_snn.study.tables import study_tables
from tests.study.test_report import GAMES, finished
from tests.viewing.test_run_report import Page

__all__ = ["finished"]
STEPS = (100_000, 200_000, 300_000, 600_000)


@pytest.fixture(scope="module")
def evaluated(finished: tuple[Study, StudyFolder]) -> tuple[Study, StudyFolder, list[TrialResult]]:
    """The stored runs as if they had been evaluated during training: the score of each seed at four steps."""
    study, folder = finished
    shares = np.asarray([[0.5, 1.5, 0.9, 1.0], [0.2, 0.4, 0.8, 1.0], [0.9, 0.3, 0.6, 1.0]])
    results = [
        replace(
            one,
            tasks=tuple(
                replace(row, curve=tuple(zip(STEPS, row.mean * shares[(number + row.seed) % 3], strict=True)))
                for number, row in enumerate(one.tasks)
            ),
        )
        for one in read_results(study, folder)
    ]
    return study, folder, results


@pytest.mark.slow
def test_profiles_are_shares_of_scores_above_thresholds(
    evaluated: tuple[Study, StudyFolder, list[TrialResult]],
) -> None:
    study, folder, results = evaluated
    (chart,) = study_figures(study, results)["Performance profiles"]
    assert isinstance(chart, Chart)
    references = json.loads((folder.path / "study.json").read_text())["references"]
    for series, variant in zip(chart.series, ("bfloat16", "switchmt"), strict=True):
        assert series.name == f"{variant} (3 seeds)"
        rows = [row for one in results if one.trial.variant == variant for row in one.tasks]
        shares = np.asarray([min(row.mean / references[row.task], 1.0) for row in rows])
        assert series.x == THRESHOLDS
        assert series.y == pytest.approx([float(np.mean(shares > at)) for at in THRESHOLDS])
        assert all(low <= y <= high for low, y, high in zip(series.low, series.y, series.high, strict=True))  # type: ignore[operator]
        assert any(low < high for low, high in zip(series.low, series.high, strict=True))  # type: ignore[operator]


@pytest.mark.slow
def test_a_matrix_is_what_each_task_lost_since_its_best(
    evaluated: tuple[Study, StudyFolder, list[TrialResult]],
) -> None:
    study, _, results = evaluated
    matrices = study_figures(study, results)["What was forgotten"]
    assert [one.name for one in matrices] == ["forgotten_switchmt", "forgotten_bfloat16"]
    for matrix, variant in zip(matrices, ("switchmt", "bfloat16"), strict=True):
        assert isinstance(matrix, Timeline)
        assert matrix.rows == GAMES
        assert len(matrix.spans) == len(GAMES) * (len(STEPS) - 1)
        for span in matrix.spans:
            task, place = GAMES[span.row], STEPS.index(int(span.end))
            rows = [row for one in results for row in one.tasks if row.task == task]
            own = [[mean for _, mean in row.curve] for row in rows if row.variant == variant]
            lost = np.mean([max(curve[:place]) - curve[place] for curve in own])
            best = max(
                np.mean([row.curve[at][1] for row in rows if row.variant == name])
                for name in ("switchmt", "bfloat16")
                for at in range(len(STEPS))
            )
            floor = np.mean([row.random_mean for row in rows])
            assert span.share == pytest.approx(min(max(lost / (best - floor), 0.0), 1.0))
        assert any(span.share > 0 for span in matrix.spans)


@pytest.mark.slow
def test_what_fresh_statistics_restore_stands_beside_what_was_lost(
    evaluated: tuple[Study, StudyFolder, list[TrialResult]], tmp_path: Path
) -> None:
    """A trial that was evaluated with fresh statistics twice: the more batches count, and nothing else changes."""
    study, folder, results = evaluated
    first = results[0]
    run = RunFolder(shutil.copytree(folder.run(first.trial), tmp_path / "trials" / first.trial.name))
    final = TrialRun(run.path).final
    assert final is not None
    run.reestimated_evaluations.folder.mkdir()
    for batches, gain in ((16, 1.0), (2, 50.0)):
        protocol = {**final["protocol"], "statistics_batches": batches}
        tasks = [{**row, "mean": row["mean"] + gain} for row in final["tasks"]]
        path = run.reestimated_evaluations.folder / f"step-{final['step']:012d}_{batches}.json"
        path.write_text(json.dumps({"step": final["step"], "protocol": protocol, "tasks": tasks}))
    alone = Study(study.name, (first.trial,), {}, first.trial.variant)
    (found,) = read_results(alone, StudyFolder(tmp_path))
    assert [row.reestimated for row in found.tasks] == [row.mean + 1.0 for row in found.tasks]
    assert [replace(row, reestimated=None, curve=()) for row in found.tasks] == [
        replace(row, curve=()) for row in first.tasks
    ]
    drawn = replace(
        first,
        tasks=tuple(replace(row, reestimated=row.mean + 1.0) for row in first.tasks),
    )
    table = next(one for one in study_tables(alone, [drawn]) if one.name == "training")
    cells = dict(zip(table.columns, table.rows[0], strict=True))
    for row in first.tasks:
        earlier = max(mean for _, mean in row.curve[:-1])
        assert cells[f"lost, re-estimated {row.task}"].value == pytest.approx(earlier - row.mean - 1.0)
        assert cells[f"lost {row.task}"].value == pytest.approx(earlier - row.curve[-1][1])


def test_without_curves_references_or_switches_a_figure_is_left_out(
    evaluated: tuple[Study, StudyFolder, list[TrialResult]],
) -> None:
    study, _, results = evaluated
    single = [replace(one, tasks=tuple(replace(row, curve=row.curve[-1:]) for row in one.tasks)) for one in results]
    assert set(study_figures(study, single)) == {"Performance profiles", "Switching"}
    assert set(study_figures(replace(study, references={}), single)) == {"Switching"}
    alone = [one for one in results if one.trial.seed == 1]
    (chart,) = study_figures(replace(study, references={"breakout": 6.0, "asterix": 2.0}), alone)[
        "Performance profiles"
    ]
    assert all(series.low == () for series in chart.series)


@pytest.mark.slow
def test_every_figure_is_on_the_page_and_in_three_files(
    evaluated: tuple[Study, StudyFolder, list[TrialResult]], monkeypatch: pytest.MonkeyPatch
) -> None:
    study, folder, results = evaluated
    monkeypatch.setattr(report, "read_results", lambda *_: results)
    page_path = report.write_study_report(study, folder)
    assert page_path is not None
    page = Page(page_path.read_text(encoding="utf-8"))
    shown = " ".join(" ".join(page.text).split())
    sections = study_figures(study, results)
    facts = json.loads((folder.path / "report.json").read_text())
    assert list(facts["figures"]) == ["learning", *sections]
    for title, figures in sections.items():
        assert title in shown
        for figure in figures:
            assert figure.title in shown
            for ending in ("svg", "png", "csv"):
                stored: Path = folder.path / "report_figures" / f"{figure.name}.{ending}"
                assert stored.stat().st_size > 60
            assert figure_files([figure])[f"{figure.name}.csv"] == stored.read_bytes()
    with (folder.path / "report_figures" / "switching_bfloat16.csv").open() as stream:
        assert {row["row"] for row in csv.DictReader(stream)} == {*GAMES}
