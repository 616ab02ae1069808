"""The files of a study's report: tables.md, study.json, CSV files of the raw numbers, and report.html."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from switchmt_snn.config.numbers import exact
from switchmt_snn.errors import RunFolderError
from switchmt_snn.runs.files import json_text, write_atomically
from switchmt_snn.study.figures import study_figures
from switchmt_snn.study.folder import StudyFolder
from switchmt_snn.study.grid import Study
from switchmt_snn.study.results import TrialResult, read_results
from switchmt_snn.study.tables import Results, Table, references_of, study_tables, why_no_shares
from switchmt_snn.viewing.report.page import write_comparison

_MOST_NAMED = 10
"""Unfinished trials that the tables name."""


def write_study_report(study: Study, folder: StudyFolder) -> Path:
    """Write the report of the trials that have finished.

    Returns:
        The path of ``report.html``.

    Raises:
        RunFolderError: the study has not been begun, no trial has finished, a trial's log cannot be read, or the folder
            cannot be written.
    """
    results = read_results(study, folder.require())
    if not results:
        raise RunFolderError(f"no trial of {folder.path} has finished, expected one; train the study first")
    tables = study_tables(study, results)
    headline = _headline(study, results)
    contents = {
        "tables.md": _markdown(study, headline, tables),
        "study.json": json_text(_facts(study, headline, results, tables), indent=1),
        "trials.csv": _csv(TRIAL_COLUMNS, map(_trial_row, results)),
        "scores.csv": _csv(SCORE_COLUMNS, (row for one in results for row in _score_rows(one))),
        "curves.csv": _csv(CURVE_COLUMNS, (row for one in results for row in _curve_rows(one))),
    }
    for name, text in contents.items():
        write_atomically(folder.path / name, text.encode())
    groups = {name: [one.run for one in results if one.trial.variant == name] for name in study.variants}
    return write_comparison(
        {name: runs for name, runs in groups.items() if runs},
        folder.path,
        title=f"Study {study.name}",
        headline=headline,
        sections=study_figures(study, results),
        tables=[{"title": one.title, "note": one.note, "columns": one.columns, "rows": one.texts()} for one in tables],
    )


TRIAL_COLUMNS = ("trial", "variant", "seed", "step", "updates", "switches", "protocol")
SCORE_COLUMNS = (
    "trial",
    "variant",
    "seed",
    "task",
    "mean",
    "standard_error",
    "random_mean",
    "episodes",
    "steps",
    "updates",
    "visits",
)
CURVE_COLUMNS = ("trial", "variant", "seed", "task", "step", "mean")


def _trial_row(one: TrialResult) -> tuple[Any, ...]:
    trial = one.trial
    return trial.name, trial.variant, trial.seed, one.step, one.updates, one.switches, one.protocol


def _score_rows(one: TrialResult) -> list[tuple[Any, ...]]:
    return [tuple(getattr(row, column) for column in SCORE_COLUMNS) for row in one.tasks]


def _curve_rows(one: TrialResult) -> list[tuple[Any, ...]]:
    return [(row.trial, row.variant, row.seed, row.task, step, mean) for row in one.tasks for step, mean in row.curve]


def _csv(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Numbers as they read back."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([exact(value) if isinstance(value, float) else value for value in row] for row in rows)
    return text.getvalue()


def _headline(study: Study, results: Sequence[TrialResult]) -> str:
    finished = {one.trial.name for one in results}
    missing = [trial.name for trial in study.trials if trial.name not in finished]
    without = why_no_shares(Results(study, results))
    shares = "" if without is None else f" No shares of the references and no decision: {without}."
    if not missing:
        return f"All {len(study.trials)} trials finished.{shares}"
    named = ", ".join(missing[:_MOST_NAMED]) + (", ..." if len(missing) > _MOST_NAMED else "")
    return f"{len(finished)} of {len(study.trials)} trials finished. Not finished: {named}.{shares}"


def _markdown(study: Study, headline: str, tables: Sequence[Table]) -> str:
    lines = [f"# Study {study.name}", "", headline]
    for table in tables:
        lines += ["", f"## {table.title}", "", table.note, "", _row(table.columns)]
        lines += ["|" + "|".join("---" if index == 0 else "---:" for index in range(len(table.columns))) + "|"]
        lines += [_row(row) for row in table.texts()]
    return "\n".join(lines) + "\n"


def _row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _facts(study: Study, headline: str, results: Sequence[TrialResult], tables: Sequence[Table]) -> dict[str, Any]:
    return {
        "format": 1,
        "study": study.name,
        "headline": headline,
        "baseline": study.baseline,
        "references": references_of(Results(study, results)),
        "trials": [
            {
                **dict(zip(TRIAL_COLUMNS, _trial_row(one), strict=True)),
                "tasks": [dict(zip(SCORE_COLUMNS[3:], row[3:], strict=True)) for row in _score_rows(one)],
            }
            for one in results
        ],
        "tables": [table.to_dict() for table in tables],
    }
