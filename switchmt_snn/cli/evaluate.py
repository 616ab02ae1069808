"""``switchmt-snn evaluate``: play a run's agent and the random policy."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from typing import Any, Literal

from switchmt_snn.cli.parsing import parse, split_one
from switchmt_snn.errors import ConfigError
from switchmt_snn.viewing import output


@dataclass(frozen=True)
class EvaluateOptions:
    """Play a run's agent and the random policy. Default of every setting: the run's own."""

    episodes: int | None = None
    """Episodes per task."""
    epsilon: float | None = None
    """Share of random actions."""
    seed: int | None = None
    """Seed of environments and random actions."""
    num_envs: int | None = None
    """Episodes played side by side."""
    max_episode_steps: int | None = None
    """Longer episodes are cut off."""
    task: str | None = None
    """Only this task."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    runtime: Literal["torch", "onnx", "nir"] = "torch"
    """What plays. torch: the trained network. onnx: the run's ONNX file in onnxruntime. nir: its NIR files in the NIR
    interpreter."""
    reestimate_batches: int = 0
    """Re-estimate normalisation statistics from so many batches of each task's replay. Tells a task that is forgotten
    from one whose statistics are old. 0: those stored with the weights."""
    trust: bool = False
    """Import modules that the run names, although you did not make it: this runs their code."""
    json: bool = False
    """Print the scores as JSON."""


def command(argv: list[str]) -> int:
    """Run the command; returns its exit code."""
    run, rest = split_one(EvaluateOptions, argv, "evaluate", EvaluateOptions())
    options = parse(EvaluateOptions, rest, "evaluate", EvaluateOptions())
    from switchmt_snn.runs.folder import RunFolder
    from switchmt_snn.runs.packing import open_run
    from switchmt_snn.runs.trained import evaluate
    from switchmt_snn.viewing.progress_bar import ProgressBars
    from switchmt_snn.viewing.tables import evaluation_table

    path = open_run(run).path
    names = ("episodes", "epsilon", "seed", "num_envs", "max_episode_steps")
    protocol = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    facts: dict[str, Any] = {}
    if options.runtime == "torch":
        with ProgressBars():
            batches = options.reestimate_batches
            evaluation = evaluate(
                path, options.task, options.checkpoint, note=_say, reestimate_batches=batches, **protocol
            )
    else:
        if options.reestimate_batches:
            raise ConfigError(
                f"--reestimate-batches is {options.reestimate_batches}, expected 0 with --runtime {options.runtime}: "
                "exported files keep the statistics that they were written with"
            )
        from switchmt_snn.export.export_run import evaluate_exported

        with ProgressBars():
            evaluation, share = evaluate_exported(options.runtime, path, options.task, options.checkpoint, **protocol)
        facts = {"runtime": options.runtime, "equal_actions_share": share}
    path = open_run(path, to_write=True).path  # where it was written
    if options.json:
        output.print_json({"run": str(path), **facts, **evaluation.to_dict()})
        return 0
    output.console().print(evaluation_table(evaluation))
    if facts:
        print(f"played by {options.runtime}; {share:.2%} of its decisions are those of the trained network")
        print(path / "export" / "evaluations")
    else:
        run_folder = RunFolder(path)
        print((run_folder.reestimated_evaluations if options.reestimate_batches else run_folder.evaluations).folder)
    return 0


def _say(text: str) -> None:
    print(text, file=sys.stderr)
