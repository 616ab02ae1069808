"""The studies under results/studies: their tables recomputed from their CSV files, without the package."""

from __future__ import annotations

import csv
import json
from collections import defaultdict
from pathlib import Path
from statistics import fmean
from typing import Any

import pytest

STUDIES = sorted((Path(__file__).parents[2] / "results" / "studies").glob("*/study.json"))


def short(task: str) -> str:
    return task.rsplit(":", 1)[-1]


@pytest.mark.parametrize("path", STUDIES, ids=lambda path: str(path.parent.name))
def test_tables_are_those_of_the_csv_files(path: Path) -> None:
    facts = json.loads(path.read_text())
    tables: dict[str, dict[str, Any]] = {
        one["name"]: {row["variant"]: row for row in one["rows"]} for one in facts["tables"]
    }
    with (path.parent / "scores.csv").open() as file:
        rows = list(csv.DictReader(file))
    scores: dict[tuple[str, str], dict[str, float]] = defaultdict(dict)
    random: dict[str, list[float]] = defaultdict(list)
    for row in rows:
        scores[row["variant"], row["seed"]][row["task"]] = float(row["mean"])
        random[row["task"]].append(float(row["random_mean"]))
    references = facts["references"]
    assert set(references) == set(random)
    floors = {task: fmean(means) if min(references.values()) <= 0 else 0.0 for task, means in random.items()}
    variants = dict.fromkeys(variant for variant, _ in scores)
    assert len(variants) > 1
    for variant in variants:
        seeds = [means for (name, _), means in scores.items() if name == variant]
        assert tables["scores"][variant]["seeds"] == len(seeds)
        harmonic = []
        for means in seeds:
            shares = [min((means[task] - floors[task]) / (references[task] - floors[task]), 1.0) for task in references]
            harmonic.append(len(shares) / sum(1 / share for share in shares) if min(shares) > 0 else 0.0)
        assert tables["shares"][variant]["harmonic mean"]["value"] == pytest.approx(fmean(harmonic))
        for task in references:
            shown = tables["scores"][variant][short(task)]["value"]
            assert shown == pytest.approx(fmean(means[task] for means in seeds))
            steps = [int(row["steps"]) for row in rows if (row["variant"], row["task"]) == (variant, task)]
            assert tables["played"][variant][f"steps {short(task)}"] == round(fmean(steps))
