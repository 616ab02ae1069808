"""The command line: parse, call, print. No logic."""

from __future__ import annotations

import contextlib
import io
import json
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import tyro
from rich.console import Console

from switchmt_snn import __version__
from switchmt_snn.config import ExperimentConfig, load_config, resolve, to_yaml
from switchmt_snn.errors import ConfigError, SwitchMTError, did_you_mean

USAGE = """\
usage: switchmt-snn COMMAND [options]

  train [CONFIG]      train, or continue a run (CONFIG: a YAML file or a preset; default: quickstart)
  evaluate [RUN]      play a run's agent and the random policy under a stated protocol (default: newest run)
  export [RUN]        write the network as ONNX and NIR files, and prove that they decide alike (default: newest run)
  profile [RUN ...]   spikes, operations, energy and chips on recorded play, with a report (default: newest run)
  describe [CONFIG]   layers, parameters, operations and memory of the seven methods, before anything runs
  doctor              versions, games and devices of this installation

  switchmt-snn COMMAND --help shows a command's options; --version the version.
  Exit codes: 0 done, 1 the run failed, 2 wrong use, 130 stopped by Ctrl-C (the same command with --run continues).
"""


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


@dataclass(frozen=True)
class EvaluateOptions:
    """Play a run's agent and the random policy; settings that are not given are the run's own."""

    episodes: int | None = None
    """Episodes per task."""
    epsilon: float | None = None
    """Share of random actions."""
    seed: int | None = None
    """Seed of environments and random actions."""
    num_envs: int | None = None
    """Episodes played side by side."""
    task: str | None = None
    """Only this task."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    engine: Literal["torch", "onnx", "nir"] = "torch"
    """What plays: the trained network, or the run's exported files in onnxruntime or the NIR interpreter."""
    json: bool = False
    """Print the scores as JSON."""


@dataclass(frozen=True)
class ExportOptions:
    """Write a run's network as ONNX and NIR files, and compare them with it; without a format: all that fit it."""

    onnx: bool = False
    """decision.onnx (all tasks, frames in, Q-values out) and step.onnx (one simulation step, membranes outside)."""
    nir: bool = False
    """One NIR graph and one JSON file per task."""
    task: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Also decision_TASK.onnx with this task folded in; may be given several times."""
    int8: bool = False
    """Weights as 8-bit integers, symmetric per output channel; the effect on decisions is measured."""
    nir_profile: Literal["portable", "spikingjelly", "exact", "legacy"] = "portable"
    """portable: most importers. spikingjelly: SpikingJelly with its default dt. exact: also reset by subtraction (uses
    loops). legacy: nir 1.0.4 and older."""
    parity_decisions: int = 1000
    """Recorded decisions per task on which the files are compared with the network."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    out: Path | None = None
    """Folder to write to. Default: the run's export/."""
    json: bool = False
    """Print files and parity as JSON."""


@dataclass(frozen=True)
class ProfileOptions:
    """profile [RUN ...] or profile FILE.nir: count what a network does while it plays, and estimate its energy."""

    decisions: int = 1000
    """Recorded decisions per task."""
    target: tyro.conf.UseAppendAction[tuple[str, ...]] = ()
    """Energy target or chip: a built-in one by name, or a YAML file. May be repeated. Default: all built-in ones."""
    checkpoint: Literal["last", "best"] = "last"
    """Which weights."""
    observations: Path | None = None
    """For a NIR file: an .npz file with observations [N, ...] or encoded inputs [T, N, ...]."""
    out: Path | None = None
    """Folder to write to. Default: RUN/profile/; with several runs, the comparison goes into the first one's."""
    json: bool = False
    """Print the profile as JSON."""


@dataclass(frozen=True)
class DescribeOptions:
    """Describe what a config would build; every setting of the config is an option."""

    experiment: Annotated[ExperimentConfig, tyro.conf.arg(name="")]
    json: bool = False
    """Print everything as JSON."""


@dataclass(frozen=True)
class DoctorOptions:
    """Check this installation."""

    json: bool = False
    """Print the facts as JSON."""


def main(argv: list[str] | None = None) -> None:
    """Entry point of ``switchmt-snn``; exits with the code of USAGE."""
    sys.exit(_main(sys.argv[1:] if argv is None else argv))


def _main(argv: list[str]) -> int:
    commands: dict[str, Callable[[list[str]], int]] = {
        "train": _train,
        "evaluate": _evaluate,
        "export": _export,
        "profile": _profile,
        "describe": _describe,
        "doctor": _doctor,
    }
    if not argv or argv[0] in ("-h", "--help", "help"):
        print(USAGE, end="")
        return 0 if argv else 2
    if argv[0] == "--version":
        print(f"switchmt-snn {__version__}")
        return 0
    try:
        if argv[0] not in commands:
            raise ConfigError(f"unknown command {argv[0]!r}{did_you_mean(argv[0], commands)}")
        return commands[argv[0]](argv[1:])
    except SwitchMTError as error:
        print(f"switchmt-snn: {error}", file=sys.stderr)
        return error.exit_code
    except KeyboardInterrupt:
        print("switchmt-snn: interrupted", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 0
    except OSError as error:
        print(
            f"switchmt-snn: the system refused ({error}), expected readable files and room on the disk", file=sys.stderr
        )
        return 1


def _train(argv: list[str]) -> int:
    source, rest = _leading_name(argv)
    run = _peek(rest, "--run")
    default = _starting_config(source, run)
    options = _parse(TrainOptions, rest, "train", TrainOptions(experiment=default))
    config = resolve(options.experiment)
    if options.print_config:
        print(to_yaml(config), end="")
        return 0
    from switchmt_snn.runs.run import Observer, train
    from switchmt_snn.viewing.progress import Progress
    from switchmt_snn.viewing.tables import evaluation_table
    from switchmt_snn.viewing.tensorboard import TensorBoard

    console = Console(stderr=options.json)
    observers: list[Observer] = [Progress(console)]
    if config.recording.tensorboard:
        observers.append(TensorBoard())
    result = train(config, options.run, observers)
    if result.status == "served":
        return 0
    if options.json:
        scores = None if result.evaluation is None else result.evaluation.to_dict()
        print(json.dumps({"run": str(result.path), "status": result.status, "step": result.step, "evaluation": scores}))
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
            "learns: 'switchmt-snn train minatar' on a CPU (about 20 minutes; scores: results/minatar/README.md; "
            "extra: minatar); 'switchmt-snn train paper' is meant for a GPU."
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
    """The config that flags are laid over: the file named, else the run's own, else quickstart."""
    if source is None and run is not None:
        from switchmt_snn.runs.folder import RunFolder

        folder = RunFolder(Path(run))
        if folder.is_run:
            return folder.config()
    return load_config(source or "quickstart")


def _evaluate(argv: list[str]) -> int:
    run, rest = _leading_name(argv)
    options = _parse(EvaluateOptions, rest, "evaluate", EvaluateOptions())
    from switchmt_snn.runs.folder import latest_run
    from switchmt_snn.runs.run import evaluate
    from switchmt_snn.viewing.tables import evaluation_table

    path = Path(run) if run is not None else latest_run()
    names = ("episodes", "epsilon", "seed", "num_envs")
    protocol = {name: getattr(options, name) for name in names if getattr(options, name) is not None}
    if options.engine == "torch":
        evaluation, facts = evaluate(path, options.task, options.checkpoint, **protocol), {}
    else:
        from switchmt_snn.export.export_run import evaluate_exported

        evaluation, share = evaluate_exported(options.engine, path, options.task, options.checkpoint, **protocol)
        facts = {"runtime": options.engine, "equal_actions_share": share}
    if options.json:
        print(json.dumps({"run": str(path), **facts, **evaluation.to_dict()}))
        return 0
    Console().print(evaluation_table(evaluation))
    if facts:
        print(f"played by {options.engine}; {share:.2%} of its decisions are those of the trained network")
        print(path / "export" / f"evaluation_{options.engine}.json")
    else:
        print(path / "evaluations")
    return 0


def _export(argv: list[str]) -> int:
    run, rest = _leading_name(argv)
    options = _parse(ExportOptions, rest, "export", ExportOptions())
    from switchmt_snn.export.export_run import ExportSettings, export
    from switchmt_snn.viewing.tables import parity_table

    settings = ExportSettings(
        onnx=options.onnx,
        nir=options.nir,
        tasks=options.task,
        int8=options.int8,
        nir_dialect=options.nir_profile,
        parity_decisions=options.parity_decisions,
    )
    console = Console(stderr=options.json)
    result = export(
        Path(run) if run is not None else None,
        settings,
        options.checkpoint,
        options.out,
        lambda text: console.print(text, highlight=False, soft_wrap=True),
    )
    if options.json:
        files = {name: str(path) for name, path in result.files.items()}
        print(json.dumps({"folder": str(result.folder), "files": files, "parity": result.parity}))
        return 0
    console.print(parity_table(result.parity))
    print(result.folder)
    return 0


def _profile(argv: list[str]) -> int:
    names, rest = _leading_names(argv)
    options = _parse(ProfileOptions, rest, "profile", ProfileOptions())
    from switchmt_snn.export import ProfileResult, compare_profiles, profile, profile_file
    from switchmt_snn.runs.folder import RunFolder

    files = [name for name in names if name.endswith(".nir")]
    if (options.observations is not None) != bool(files):
        raise ConfigError(
            "a NIR file and --observations belong together, expected switchmt-snn profile FILE.nir --observations "
            "FILE.npz; a run has recorded observations of its own"
        )
    if files and (options.decisions, options.checkpoint) != (ProfileOptions.decisions, ProfileOptions.checkpoint):
        raise ConfigError("--decisions and --checkpoint are for runs, expected neither with a NIR file; leave them out")
    for path in set(names) - set(files):  # all of them, before the first is profiled
        RunFolder(Path(path)).require()
    profiles: list[ProfileResult] = []
    # With several, --out is the comparison's; each one's own files lie in its own folder.
    out = options.out if len(names) < 2 else None
    chosen: list[str | None] = [*names] or [None]  # None is the newest run
    for name in chosen:
        if name is not None and name in files:
            profiles.append(profile_file(name, cast(Path, options.observations), out, options.target))
        else:
            profiles.append(profile(name, options.decisions, options.checkpoint, out, options.target))
    report = profiles[0].folder / "report.html"
    if len(profiles) > 1:
        report = compare_profiles(profiles, options.out)
    if options.json:
        print(json.dumps(profiles[0].facts) if len(profiles) == 1 else report.with_suffix(".json").read_text())
        return 0
    _print_profiles([one.facts for one in profiles])
    print(report)
    return 0


def _print_profiles(profiles: list[dict[str, Any]]) -> None:
    from switchmt_snn.viewing.tables import comparison_table, energy_table, fit_table, profile_table

    console = Console(markup=False)  # names may hold brackets
    if len(profiles) > 1:
        console.print(comparison_table(profiles))
    for facts in profiles:
        if len(profiles) > 1:
            console.rule(facts["run"], align="left", characters="-")
        console.print(facts["headline"], soft_wrap=True)
        for task in facts["tasks"]:
            console.print(profile_table(task))
        if facts["targets"]:
            console.print(energy_table(facts))
        if facts["chips"]:
            console.print(fit_table(facts))


def _describe(argv: list[str]) -> int:
    source, rest = _leading_name(argv)
    # The paper's settings give the paper's table; a config of one's own gives its own.
    default = load_config(source or "paper")
    options = _parse(DescribeOptions, rest, "describe", DescribeOptions(experiment=default))
    from switchmt_snn.machine.memory import available_bytes
    from switchmt_snn.runs.description import describe
    from switchmt_snn.viewing.tables import layers_table, methods_table

    config = resolve(options.experiment)
    methods = describe(config)
    if options.json:
        facts: dict[str, Any] = {"config": config.name, "available_memory_bytes": available_bytes()}
        print(json.dumps({**facts, "methods": {name: method.to_dict() for name, method in methods.items()}}))
        return 0
    console = Console()
    console.print(methods_table(methods))
    console.print(layers_table(methods[config.network.method]))
    return 0


def _doctor(argv: list[str]) -> int:
    options = _parse(DoctorOptions, argv, "doctor", DoctorOptions())
    import torch

    from switchmt_snn.machine.devices import has_bfloat16, select_device
    from switchmt_snn.machine.memory import GIB, available_bytes
    from switchmt_snn.runs.environment import describe_environment
    from switchmt_snn.tasks.registry import SUITES
    from switchmt_snn.updates.engine import ENGINES

    device = select_device("auto")
    facts = describe_environment(load_config("quickstart"), device)
    facts = {key: facts[key] for key in ("versions", "python", "platform", "processor", "cores", "device")}
    facts |= {
        "torch_threads": torch.get_num_threads(),
        "tasks": {name: len(suite.known_tasks()) for name, suite in SUITES.items()},
        "available_memory_gib": round(available_bytes() / GIB, 1),
        "bfloat16_instructions": has_bfloat16(device),
        "update_engines": {name: engine.status() for name, engine in ENGINES.items()},
    }
    if options.json:
        print(json.dumps(facts))
        return 0
    for key, value in facts.items():
        shown = ", ".join(f"{k} {v or 'not installed'}" for k, v in value.items()) if isinstance(value, dict) else value
        print(f"{key}: {shown}")
    return 0


def _leading_names(argv: list[str]) -> tuple[list[str], list[str]]:
    """The positional arguments, which come first if they are there."""
    count = next((index for index, word in enumerate(argv) if word.startswith("-")), len(argv))
    return argv[:count], argv[count:]


def _leading_name(argv: list[str]) -> tuple[str | None, list[str]]:
    """The positional argument, which comes first if it is there."""
    return (argv[0], argv[1:]) if argv and not argv[0].startswith("-") else (None, argv)


def _peek(argv: list[str], flag: str) -> str | None:
    """The value of a flag before everything is parsed: it decides what the other flags are laid over."""
    for index, word in enumerate(argv):
        if word == flag and index + 1 < len(argv):
            return argv[index + 1]
        if word.startswith(f"{flag}="):
            return word.split("=", 1)[1]
    return None


def _parse(kind: Any, argv: list[str], command: str, default: Any) -> Any:
    """Parse flags over a default; tyro's boxed complaints become one line."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(kind, default=default, args=argv, prog=f"switchmt-snn {command}")
    except SystemExit as stop:
        if stop.code == 0:
            raise
        raise ConfigError(_one_line(complaint.getvalue(), command)) from None


def _one_line(boxed: str, command: str) -> str:
    """What tyro says in a box (of lines in a UTF-8 terminal, of spaces elsewhere), without title, rules and advice."""
    lines = [line.strip("│ ") for line in boxed.splitlines() if line.strip() and line[0] not in "╭╰"]
    if "│" not in boxed:
        lines = lines[1:]
    text = " ".join(line for line in lines if not set(line) <= set("─-"))
    text = text.split("For full helptext")[0].split("Argument helptext")[0].strip().rstrip(".")
    return f"{text}; see switchmt-snn {command} --help"
