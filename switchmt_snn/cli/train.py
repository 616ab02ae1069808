"""``switchmt-snn train``: train one network on several tasks, or continue a run."""

from __future__ import annotations

import os
import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from switchmt_snn.cli.parsing import for_another_suite, for_named_tasks, nearest_preset, parse, peek, split_one
from switchmt_snn.config import ExperimentConfig, load_config, resolve, to_yaml
from switchmt_snn.errors import SwitchMTError
from switchmt_snn.machine.program import program, runnable
from switchmt_snn.viewing import output

if TYPE_CHECKING:
    from rich.console import Console

    from switchmt_snn.runs.run import RunResult


@dataclass(frozen=True)
class TrainOptions:
    """Train one network on several tasks, or continue a run; every setting of the config is an option."""

    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")]
    run: Path | None = None
    """Run folder: continued if it holds a run of the same config, else made of CONFIG. Default: a new one in runs/."""
    print_config: bool = False
    """Print the resolved config as YAML and stop."""
    trust: bool = False
    """Import modules that the runs of --run and --initial-weights name, although you did not make
    them: this runs their code."""
    json: bool = False
    """Print the result as JSON (progress goes to stderr)."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    source, rest = split_one(TrainOptions, argv, "train", TrainOptions(experiment=ExperimentConfig()))
    run = peek(rest, "--run")
    default = for_named_tasks(_starting_config(source, run), rest)
    options = parse(TrainOptions, rest, "train", TrainOptions(experiment=default))
    if source is None and options.run is not None:
        from switchmt_snn.runs.folder import RunFolder

        asked = options.experiment
        preset = "quickstart" if asked.tasks.suite == default.tasks.suite else nearest_preset(asked) or "quickstart"
        again = shlex.join(["switchmt-snn", "train", preset, *rest])
        RunFolder(options.run).require(again)  # a wrong name must not begin a run of quickstart there
    config = resolve(options.experiment)
    if options.print_config:
        print(to_yaml(config, options.experiment), end="")
        return 0
    from switchmt_snn.runs.run import Observer, train
    from switchmt_snn.viewing.dashboards import chosen_dashboards
    from switchmt_snn.viewing.progress import Progress
    from switchmt_snn.viewing.tables import evaluation_table

    console = output.console(stderr=options.json)
    told = for_another_suite(source, default, config, rest, "train")
    observers: list[Observer] = [Progress(console, told), *chosen_dashboards(config.recording)]
    result = train(options.experiment, options.run, observers)
    if result.status == "served":
        return 0
    if options.json:
        scores = None if result.evaluation is None else result.evaluation.to_dict()
        output.print_json({"run": str(result.path), "status": result.status, "step": result.step, "evaluation": scores})
    if result.status == "stopped":
        again = f"{launcher()} train --run {shlex.quote(str(result.path))}"
        console.print(f"stopped at step {result.step:,}; continue exactly here with: {again}", soft_wrap=True)
    elif result.status == "already_finished":
        why = "evaluation.stop_at_returns is reached; begin another run" if result.solved else "raise the budget"
        console.print(
            f"already finished at step {result.step:,}; {why} to go on: {_how_to_go_on(config, result)}",
            soft_wrap=True,
        )
    elif result.evaluation is not None:
        console.print(evaluation_table(result.evaluation))
        _say_what_next(console, config, result)
    # A run that was killed after its last evaluation has no page yet.
    if result.status != "already_finished" or not (result.path / "report.html").is_file():
        _write_report(console, result.path)
    if not options.json:
        print(result.path)
    return 130 if result.status == "stopped" else 0


def launcher() -> str:
    """What begins a training as this one was begun: under ``torchrun`` with as many processes."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return program()
    return f"torchrun --nproc-per-node {os.environ['LOCAL_WORLD_SIZE']} -m -- switchmt_snn"


def _how_to_go_on(config: ExperimentConfig, result: RunResult) -> str:
    """The command that trains a finished run further; a run that reached its goal is the start of another one."""
    run = shlex.quote(str(result.path))
    if not result.solved:
        return f"{launcher()} train --run {run} --total-steps {2 * config.total_steps}"
    config_file = shlex.quote(str(result.path / "config.yaml"))
    return f"{launcher()} train {config_file} --initial-weights {run} --evaluation.stop-at-returns"


def _say_what_next(console: Console, config: ExperimentConfig, result: RunResult) -> None:
    from switchmt_snn.runs.folder import RunFolder
    from switchmt_snn.tasks.registry import find_suite

    lines, path, step = [], result.path, result.step
    needed = find_suite(config.tasks.suite).steps_to_learn
    if needed is not None and config.total_steps < needed:
        lines.append(
            f"This run is far too short to learn {', '.join(config.tasks.names)} (fewer than {needed:,} steps). What "
            "learns: 'switchmt-snn train cartpole' (one or two minutes), 'switchmt-snn train minatar' on a CPU (about "
            "20 minutes; scores: results/minatar/README.md; extra: minatar); 'switchmt-snn train paper' is for a GPU."
        )
    run, best = shlex.quote(str(path)), RunFolder(path).checkpoints().best()
    if best is not None and best.step != step:
        judged = {"evaluation": "the evaluations during training", "returns": "the returns of training"}[best.judged_by]
        lines.append(f"The best weights by {judged} are those of step {best.step:,} (--checkpoint best).")
    lines += [
        "Next:",
        f"  switchmt-snn evaluate {run} --episodes 30",
        *([f"  switchmt-snn evaluate {run} --episodes 30 --checkpoint best"] if best and best.step != step else []),
        f"  switchmt-snn export {run}",
        f"  switchmt-snn profile {run}",
        f"  {_how_to_go_on(config, result)}",
        f"  switchmt-snn describe {shlex.quote(str(path / 'config.yaml'))}",
    ]
    for line in lines:
        console.print(runnable(line), highlight=False, soft_wrap=True)


def _write_report(console: Console, path: Path) -> None:
    """The run's page; a run that trained well does not fail because its page cannot be written."""
    from switchmt_snn.viewing.report.page import write_report

    try:
        page = write_report([path])
    except SwitchMTError as error:
        console.print(f"no report: {error}", highlight=False, soft_wrap=True)
    else:
        console.print(f"report: {page}", highlight=False, soft_wrap=True)


def _starting_config(source: str | None, run: str | None) -> ExperimentConfig:
    """The config that flags change: the file that is named, else the run's own, else quickstart's."""
    for named in (run, source):
        if named is not None:
            from switchmt_snn.runs.packing import refuse_pretrained

            refuse_pretrained(named)
    if source is None and run is not None:
        from switchmt_snn.runs.folder import RunFolder

        if RunFolder(Path(run)).is_run:
            return load_config(Path(run) / "config.yaml")
    return load_config(source or "quickstart")
