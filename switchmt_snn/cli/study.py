"""``switchmt-snn study``: many runs from one YAML file, their tables and their page."""

from __future__ import annotations

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.errors import ConfigError, SwitchMTError
from switchmt_snn.machine.program import program
from switchmt_snn.viewing import output

if TYPE_CHECKING:
    from rich.console import Console

    from switchmt_snn.study.engine import Engine
    from switchmt_snn.study.folder import StudyFolder
    from switchmt_snn.study.grid import Study


@dataclass(frozen=True)
class StudyOptions:
    """Train every trial of a study, each in its own process and run folder; the same command continues it."""

    folder: Path | None = None
    """Folder of the study: continued if it holds the same study. Default: runs/studies/NAME."""
    jobs: int | None = None
    """Trials at the same time. Default: as many as there are cores; never more."""
    engine: Literal["local", "ray"] = "local"
    """Where trials train. local: processes on this machine; ray: the nodes of a Ray cluster (extra: ray), which all see
    the study's folder (docs/studies.md)."""
    address: str = "auto"
    """--engine ray: HOST:PORT of the cluster; auto: the one that this machine is a node of."""
    gpus_per_trial: float = 0.0
    """--engine ray: the part of a GPU that each trial gets, such as 0.25."""
    seeds: tuple[int, ...] = ()
    """Seeds in place of those of the file."""
    set: tuple[str, ...] = ()
    """Settings over every trial, each as KEY=VALUE: total_steps=2000."""
    dry_run: bool = False
    """Train nothing: measure each kind of trial for half a minute, and say what all will take."""
    status: bool = False
    """Show how far the trials are, and stop."""
    report: bool = False
    """Write the report of the trials that have finished by now, and stop."""
    trust: bool = False
    """Import modules that the study's folder names, although you did not make it: this runs their code."""
    json: bool = False
    """Print the result as JSON (progress goes to stderr)."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    source, rest = split_one(StudyOptions, argv, "study", StudyOptions())
    options = parse(StudyOptions, rest, "study", StudyOptions())
    if "--seeds" in rest and not options.seeds:  # an empty list would silently be the file's
        raise ConfigError("study got --seeds without a number, expected seeds, as in --seeds 1 2 3")
    from switchmt_snn.study.grid import studies

    if source is None:
        raise ConfigError(f"study got no CONFIG, expected a YAML file or one of {', '.join(studies())}")
    study, folder = _named(source, options)
    console = output.console(stderr=options.json)
    if sum((options.dry_run, options.status, options.report)) > 1:
        raise ConfigError("study got several of --dry-run, --status and --report, expected one of them")
    if options.status or options.report or (options.dry_run and folder.is_study):
        folder.require_same(study)
    if options.status:
        return _status(console, study, folder, options.json)
    if options.engine != "ray":
        for name, value in (("--address", options.address != "auto"), ("--gpus-per-trial", options.gpus_per_trial)):
            if value:
                raise ConfigError(f"study got {name} with --engine local, expected it with --engine ray only")
    if options.dry_run:
        return _dry_run(console, study, folder, options)
    if options.report:
        _report(console, study, folder, options.json)
        return 0
    return _run(console, study, folder, options)


def _named(source: str, options: StudyOptions) -> tuple[Study, StudyFolder]:
    """The study of a folder, or of a file and its folder."""
    from switchmt_snn.study.folder import STUDIES, StudyFolder
    from switchmt_snn.study.grid import load_study

    if StudyFolder(Path(source)).is_study:
        if options.folder is not None or options.seeds or options.set:
            raise ConfigError(
                f"study got the folder {source} and --folder, --seeds or --set, expected the folder alone, or CONFIG"
            )
        folder = StudyFolder(Path(source))
        return folder.study(), folder
    study = load_study(source, options.set, options.seeds)
    return study, StudyFolder(options.folder or STUDIES / study.name)


def _status(console: Console, study: Study, folder: StudyFolder, as_json: bool) -> int:
    from switchmt_snn.study.status import status_facts, status_table

    facts = status_facts(study, folder)
    if as_json:
        output.print_json(facts, indent=1)
    else:
        console.print(status_table(facts))
    return 0


def _dry_run(console: Console, study: Study, folder: StudyFolder, options: StudyOptions) -> int:
    from switchmt_snn.study.estimate import cost_facts, cost_table
    from switchmt_snn.study.folder import require_trusted_trials
    from switchmt_snn.study.local import jobs_for
    from switchmt_snn.study.probe import probe

    require_trusted_trials(study.trials)
    jobs = jobs_for(study.trials, options.jobs)
    trials = study.trials
    if folder.is_study:
        trials = tuple(one.trial for one in folder.progress(study) if one.status != "finished")
    costs = probe(trials, jobs, lambda text: console.print(text, highlight=False, soft_wrap=True))
    facts = cost_facts(study, trials, costs, jobs, folder.path)
    if options.json:
        output.print_json(facts, indent=1)
    else:
        console.print(cost_table(facts))
    return 0


def _report(console: Console, study: Study, folder: StudyFolder, as_json: bool) -> None:
    """The report of what has finished.

    Raises:
        RunFolderError: no trial has finished, or something cannot be read or written.
    """
    from switchmt_snn.study.report import write_study_report

    page = write_study_report(study, folder)
    console.print(f"tables: {folder.path / 'tables.md'}; report: {page}", highlight=False, soft_wrap=True)
    if as_json:
        output.print_json((folder.path / "study.json").read_text("utf-8"))


def _run(console: Console, study: Study, folder: StudyFolder, options: StudyOptions) -> int:
    from switchmt_snn.runs.signals import stop_requests
    from switchmt_snn.study.engine import run_trials
    from switchmt_snn.study.folder import require_trusted_trials
    from switchmt_snn.study.watching import Screen

    require_trusted_trials(study.trials)
    engine = _engine(options)
    jobs = engine.jobs(study.trials, options.jobs)
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
            failed = run_trials(waiting, folder, jobs, engine, screen, requested)
            stopped = requested()
        try:
            _report(console, study, folder, options.json)
        except SwitchMTError as error:  # trials that trained well do not fail because their page cannot be written
            console.print(f"no report: {error}", highlight=False, soft_wrap=True)
    finally:
        lock.release()
    _say_how_to_go_on(console, how_to_go_on(folder.path, options), stopped, [trial.name for trial in failed])
    return 130 if stopped else 1 if failed else 0


def _engine(options: StudyOptions) -> Engine:
    if options.engine == "local":
        from switchmt_snn.study.local import LocalEngine

        return LocalEngine()
    if options.engine == "ray":
        from switchmt_snn.study.ray_cluster import RayEngine

        return RayEngine(options.address, options.gpus_per_trial)
    raise ConfigError(f"--engine is {options.engine!r}, expected local or ray")


def how_to_go_on(path: Path, options: StudyOptions) -> str:
    """The command that continues a study in a folder, where and as wide as it was asked for."""
    words = ["study", str(path)]
    for name in ("jobs", "engine", "address", "gpus_per_trial"):
        value = getattr(options, name)
        if value != getattr(StudyOptions, name):
            words += [f"--{name.replace('_', '-')}", str(value)]
    return f"{program()} {shlex.join(words)}"


def _say_how_to_go_on(console: Console, again: str, stopped: bool, failed: list[str]) -> None:
    if failed:
        console.print(f"failed: {', '.join(failed)}; try them again with: {again}", highlight=False, soft_wrap=True)
    elif stopped:
        console.print(f"stopped; continue exactly here with: {again}", highlight=False, soft_wrap=True)
