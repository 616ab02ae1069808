"""``switchmt-snn train``: train one network on several tasks, or continue a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro
from rich.console import Console

from switchmt_snn.cli.parsing import leading_name, parse, peek
from switchmt_snn.config import ExperimentConfig, load_config, resolve, to_yaml
from switchmt_snn.runs.files import json_text


@dataclass(frozen=True)
class TrainOptions:
    """Train one network on several tasks, or continue a run; every setting of the config is an option."""

    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")]
    run: Path | None = None
    """Run folder: continued if it holds a run of the same config, otherwise made. Default: a new one in runs/."""
    print_config: bool = False
    """Print the resolved config as YAML and stop."""
    json: bool = False
    """Print the result as JSON (progress goes to stderr)."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    source, rest = leading_name(argv)
    run = peek(rest, "--run")
    default = _starting_config(source, run)
    options = parse(TrainOptions, rest, "train", TrainOptions(experiment=default))
    config = resolve(options.experiment)
    if options.print_config:
        print(to_yaml(config, options.experiment), end="")
        return 0
    from switchmt_snn.runs.run import Observer, train
    from switchmt_snn.viewing.progress import Progress
    from switchmt_snn.viewing.tables import evaluation_table
    from switchmt_snn.viewing.tensorboard import TensorBoard

    console = Console(stderr=options.json)
    observers: list[Observer] = [Progress(console)]
    if config.recording.tensorboard:
        observers.append(TensorBoard())
    result = train(options.experiment, options.run, observers)
    if result.status == "served":
        return 0
    if options.json:
        scores = None if result.evaluation is None else result.evaluation.to_dict()
        print(json_text({"run": str(result.path), "status": result.status, "step": result.step, "evaluation": scores}))
    again = f"switchmt-snn train --run {result.path}"
    if result.status == "stopped":
        console.print(f"stopped at step {result.step:,}; continue exactly here with: {again}", soft_wrap=True)
    elif result.status == "already_finished":
        console.print(
            f"already finished at step {result.step:,}; raise the budget to go on: {again} --total-steps "
            f"{2 * config.total_steps}",
            soft_wrap=True,
        )
    elif result.evaluation is not None:
        console.print(evaluation_table(result.evaluation))
        _say_what_next(console, config, result.path)
    if not options.json:
        print(result.path)
    return 130 if result.status == "stopped" else 0


def _say_what_next(console: Console, config: ExperimentConfig, path: Path) -> None:
    from switchmt_snn.tasks.registry import find_suite

    lines = []
    needed = find_suite(config.tasks.suite).steps_to_learn
    if needed is not None and config.total_steps < needed:
        lines.append(
            f"This run is far too short to learn {', '.join(config.tasks.names)} (fewer than {needed:,} steps). What "
            "learns: 'switchmt-snn train cartpole' (a minute), 'switchmt-snn train minatar' on a CPU (about 20 "
            "minutes; scores: results/minatar/README.md; extra: minatar); 'switchmt-snn train paper' is for a GPU."
        )
    lines += [
        "Next:",
        f"  switchmt-snn evaluate {path} --episodes 30",
        f"  switchmt-snn export {path}",
        f"  switchmt-snn profile {path}",
        f"  switchmt-snn train --run {path} --total-steps {2 * config.total_steps}",
        "  switchmt-snn describe",
    ]
    for line in lines:
        console.print(line, highlight=False, soft_wrap=True)


def _starting_config(source: str | None, run: str | None) -> ExperimentConfig:
    """The config that flags change: the file that is named, else the run's own, else quickstart."""
    if source is None and run is not None:
        from switchmt_snn.runs.folder import RunFolder

        if RunFolder(Path(run)).is_run:
            return load_config(Path(run) / "config.yaml")
    return load_config(source or "quickstart")
