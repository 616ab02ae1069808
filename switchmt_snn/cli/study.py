"""``switchmt-snn study``: many runs from one YAML file, their tables and their page."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.errors import ConfigError
from switchmt_snn.runs.files import json_text
from switchmt_snn.viewing import output

if TYPE_CHECKING:
    from switchmt_snn.study.folder import StudyFolder
    from switchmt_snn.study.grid import Study


@dataclass(frozen=True)
class StudyOptions:
    """Train every trial of a study, each in its own process and run folder; the same command continues it."""

    folder: Path | None = None
    """Folder of the study: continued if it holds the same study. Default: runs/studies/NAME."""
    jobs: int | None = None
    """Trials at the same time. Default: as many as there are cores; never more."""
    seeds: tuple[int, ...] = ()
    """Seeds in place of those of the file."""
    set: tuple[str, ...] = ()
    """Settings over every trial, each as KEY=VALUE: total_steps=2000."""
    status: bool = False
    """Show how far the trials are, and stop."""
    json: bool = False
    """Print the result as JSON (progress goes to stderr)."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    source, rest = split_one(StudyOptions, argv, "study", StudyOptions())
    options = parse(StudyOptions, rest, "study", StudyOptions())
    from switchmt_snn.study.folder import STUDIES, StudyFolder
    from switchmt_snn.study.grid import load_study, studies

    if source is None:
        raise ConfigError(f"study got no CONFIG, expected a YAML file or one of {', '.join(studies())}")
    if StudyFolder(Path(source)).is_study:
        if options.folder is not None or options.seeds or options.set:
            raise ConfigError(
                f"study got the folder {source} and --folder, --seeds or --set, expected the folder alone, or CONFIG"
            )
        folder = StudyFolder(Path(source))
        study = folder.study()
    else:
        study = load_study(source, options.set, options.seeds)
        folder = StudyFolder(options.folder or STUDIES / study.name)
    console = output.console(stderr=options.json)
    if options.status:
        return _status(console, study, folder, options.json)
    return _run(console, study, folder, options)


def _status(console: Console, study: Study, folder: StudyFolder, as_json: bool) -> int:
    from switchmt_snn.study.status import status_facts, status_table

    facts = status_facts(study, folder)
    if as_json:
        print(json_text(facts, indent=1))
    else:
        console.print(status_table(facts))
    return 0


def _run(console: Console, study: Study, folder: StudyFolder, options: StudyOptions) -> int:
    from switchmt_snn.runs.signals import stop_requests
    from switchmt_snn.study.local import jobs_for, run_trials
    from switchmt_snn.study.watching import Screen

    jobs = jobs_for(study.trials, options.jobs)
    lock = folder.lock()
    try:
        folder.prepare(study)
        waiting = [one.trial for one in folder.progress(study) if one.status != "finished"]
        finished = len(study.trials) - len(waiting)
        console.print(
            f"study {folder.path}: {len(study.trials)} trials ({len(study.variants)} variants), {finished} finished, "
            f"{jobs} at a time",
            highlight=False,
            soft_wrap=True,
        )
        screen = Screen(console, study, folder, jobs, finished)
        with stop_requests() as requested:
            failed = run_trials(waiting, folder, jobs, screen, requested)
            stopped = requested()
    finally:
        lock.release()
    return 130 if stopped else 1 if failed else 0
