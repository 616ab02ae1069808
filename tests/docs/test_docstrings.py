"""Examples in docstrings run, in one folder and in this order: later ones read the run of ``train``."""

from __future__ import annotations

import doctest
import inspect
from pathlib import Path
from typing import Any

import pytest

from switchmt_snn.acting.agent import Agent
from switchmt_snn.config import load_config
from switchmt_snn.config.numbers import exact, whole_number
from switchmt_snn.config.other_names import meant
from switchmt_snn.config.trust import modules_in
from switchmt_snn.drawing.chart import ticks
from switchmt_snn.drawing.numbers import bytes_of, compact, duration
from switchmt_snn.errors import printable, shown
from switchmt_snn.export import load_exported, profile, to_nir, to_onnx
from switchmt_snn.export.chips.fit import check_fit
from switchmt_snn.learning.switching import SwitchingPolicy
from switchmt_snn.replay.ring import FrameReplay
from switchmt_snn.runs.files import file_name, json_text
from switchmt_snn.runs.run import train
from switchmt_snn.runs.trained import load_agent
from switchmt_snn.study.grid import load_study
from switchmt_snn.study.prize import best_split
from switchmt_snn.study.statistics import (
    area_under_curve,
    forgetting,
    harmonic_mean_over_tasks,
    holm,
    interquartile_mean,
    probability_of_improvement,
    sign_flip_test,
)
from switchmt_snn.study.timing import makespan
from switchmt_snn.tasks.gym_make import make_environment
from switchmt_snn.tasks.gym_spaces import dim_pixels, with_wrapper
from switchmt_snn.tasks.report import check_env
from switchmt_snn.viewing.names import shown_task
from switchmt_snn.viewing.report.curves import running_means, thinned
from switchmt_snn.viewing.report.page import write_report

EXAMPLES: tuple[Any, ...] = (
    load_config,
    modules_in,
    exact,
    whole_number,
    ticks,
    compact,
    bytes_of,
    duration,
    running_means,
    shown_task,
    thinned,
    write_report,
    load_study,
    interquartile_mean,
    probability_of_improvement,
    harmonic_mean_over_tasks,
    area_under_curve,
    forgetting,
    sign_flip_test,
    holm,
    makespan,
    file_name,
    meant,
    best_split,
    json_text,
    make_environment,
    dim_pixels,
    with_wrapper,
    check_env,
    printable,
    shown,
    train,
    load_agent,
    Agent.act,
    FrameReplay,
    SwitchingPolicy,
    to_onnx,
    to_nir,
    load_exported,
    profile,
    check_fit,
)
ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_examples_in_docstrings_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for part in EXAMPLES:
        names = dict(vars(inspect.getmodule(part)))  # an example may use what its module imports
        (test,) = doctest.DocTestFinder(recurse=False).find(part, part.__qualname__, globs=names)
        assert test.examples, f"{part.__qualname__} has no example"
        failures = doctest.DocTestRunner().run(test).failed
        assert failures == 0, f"the example of {part.__qualname__} fails; its output is above"


def test_every_example_of_a_docstring_is_in_the_list() -> None:
    with_examples = {
        path.relative_to(ROOT).as_posix()
        for folder in ("switchmt_snn", "export")
        for path in (ROOT / folder).rglob("*.py")
        if ">>> " in path.read_text()
    }
    files = [inspect.getsourcefile(inspect.unwrap(part)) for part in EXAMPLES]
    listed = {Path(file).resolve().relative_to(ROOT).as_posix() for file in files}
    assert with_examples == listed


def test_examples_stand_under_the_heading_that_the_site_shows_as_code() -> None:
    """Without it, ``>>>`` is read as a quotation; under "Example:" as a box of text."""
    for part in EXAMPLES:
        before, _, _ = (inspect.getdoc(part) or "").partition(">>> ")
        assert "\nExamples:\n" in before, part.__qualname__
