"""Export a run: write the files, then prove them against the trained network. Used by the command line and Python."""

from __future__ import annotations

import json
import re
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy.typing as npt
import onnx

from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol, evaluate_agent
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ConfigError, ExportError, ParityError
from switchmt_snn.export.folded import fold_agent, metadata
from switchmt_snn.export.formats.nir_writer import DIALECT_KEY, NirDialect, nir_graph, write_nir
from switchmt_snn.export.formats.obstacles import obstacles
from switchmt_snn.export.formats.onnx_graph import OPSET
from switchmt_snn.export.formats.onnx_writer import decision_model, step_model
from switchmt_snn.export.parity.compare import Exports
from switchmt_snn.export.parity.proof import prove
from switchmt_snn.export.provenance import provenance
from switchmt_snn.export.recording import Recording, recorded_plays
from switchmt_snn.export.runtimes.agents import ComparedAgent, NirAgent, OnnxAgent, read_nir
from switchmt_snn.runs.files import file_name, write_atomically
from switchmt_snn.runs.folder import RunFolder, latest_run
from switchmt_snn.runs.run import load_agent
from switchmt_snn.spiking.folding import FoldedNetwork, quantized
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.tasks.suite import TaskSuite

Note = Callable[[str], None]


@dataclass(frozen=True)
class ExportResult:
    """What was written and how it compares.

    Attributes:
        files: paths by what they are.
        parity: the content of ``parity.json``.
        left_out: formats that cannot express the network, with the reason; empty if a format was asked for.
    """

    folder: Path
    files: dict[str, Path]
    parity: dict[str, Any]
    left_out: dict[str, str]


@dataclass(frozen=True)
class ExportSettings:
    """What to write.

    Attributes:
        onnx: ``decision.onnx`` for all tasks, and ``step.onnx`` if the network spikes. With neither ``onnx`` nor
            ``nir``, every format that can express the network is written; ``ExportResult.left_out`` names the others.
        nir: one ``<task>.nir`` and ``<task>.json`` per task.
        tasks: also one ``decision_<task>.onnx`` for each of these.
        int8: store the weights as 8-bit integers with one step per output channel.
        nir_dialect: see ``switchmt_snn.export.formats.nir_writer``.
        parity_decisions: recorded decisions per task that the files are compared on.
    """

    onnx: bool = False
    nir: bool = False
    tasks: tuple[str, ...] = ()
    int8: bool = False
    nir_dialect: NirDialect = "portable"
    parity_decisions: int = 1000


def export(
    run: str | Path | None = None,
    settings: ExportSettings | None = None,
    checkpoint: str = "last",
    out: str | Path | None = None,
    note: Note = lambda text: None,
) -> ExportResult:
    """Write a run's network as ONNX and NIR files and check them.

    Args:
        run: run folder; None takes the newest under ``runs/``.
        settings: what to write.
        checkpoint: ``last`` or ``best``.
        out: where; None takes the run's ``export/`` folder.
        note: told in a line what goes on.

    Raises:
        ExportError: a format that was asked for cannot express the network, or none can.
        ParityError: a file decides differently; ``parity.json`` says where.
    """
    settings = settings or ExportSettings()
    if settings.parity_decisions < 1:
        raise ConfigError(f"parity_decisions is {settings.parity_decisions}, expected at least 1")
    if settings.tasks and settings.nir and not settings.onnx:
        raise ConfigError(
            "--task names a decision_TASK.onnx, expected --onnx with it (--nir writes every task); add --onnx"
        )
    run_folder = RunFolder(Path(run) if run is not None else latest_run()).require()
    agent = load_agent(run_folder.path, checkpoint, "cpu")
    specialised = tuple(agent.suite.names[agent.suite.index(task)] for task in settings.tasks)
    network = fold_agent(agent)
    exported = quantized(network) if settings.int8 else network
    settings, left_out = _formats_that_fit(settings, network)
    for name, reason in left_out.items():
        note(f"left out {name.upper()}: {reason}")
    folder = _made(Path(out) if out is not None else run_folder.path / "export")
    started = time.perf_counter()
    facts = provenance(run_folder.path) | {"weights": "int8" if settings.int8 else "float32"}
    files: dict[str, Path] = {}
    if settings.onnx:
        files |= _write_onnx(exported, folder, specialised, facts)
    if settings.nir:
        files |= _write_nir(exported, folder, settings.nir_dialect, facts)
    for name, path in files.items():
        note(f"wrote {path} ({name})")
    written_at = time.perf_counter()
    note("parity: comparing the files with the trained network on recorded play")
    recordings: list[Recording] = []

    def arriving() -> Iterator[npt.NDArray[Any]]:
        for recording in recorded_plays(agent, run_folder.path / "recordings", settings.parity_decisions):
            recordings.append(recording)
            yield recording.observations

    parity = prove(agent, _read_back(exported, files), arriving())
    parity["protocol"] = {
        r.task: {"decisions": len(r.actions), "epsilon": r.epsilon, "seed": r.seed} for r in recordings
    }
    parity["wall_s"] = {"write": written_at - started, "record_and_compare": time.perf_counter() - written_at}
    parity["left_out"] = left_out
    write_atomically(folder / "parity.json", json.dumps(facts | parity, indent=1).encode())
    if parity["dyadic_skipped"] is not None:
        note(f"the exact check was left out: {parity['dyadic_skipped']}")
    if parity["failures"]:
        raise ParityError(
            f"parity failed: {'; '.join(parity['failures'])}; expected the trained network's decisions; see "
            f"{folder / 'parity.json'}"
        )
    return ExportResult(folder, files, parity, left_out)


def _made(folder: Path) -> Path:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ExportError(
            f"{folder} cannot be made ({error.strerror}), expected a folder to write to; use --out"
        ) from error
    return folder


def _formats_that_fit(settings: ExportSettings, network: FoldedNetwork) -> tuple[ExportSettings, dict[str, str]]:
    """The settings with every format that fits if none was asked for, and why others are left out.

    Raises:
        ExportError: no format fits, or one task's ONNX file was asked for and ONNX does not.
    """
    if settings.onnx or settings.nir:
        return settings, {}
    left_out = obstacles(network, settings.nir_dialect)
    if "onnx" in left_out and (settings.tasks or "nir" in left_out):
        raise ExportError(". ".join(left_out[name] for name in left_out if name == "onnx" or not settings.tasks))
    return replace(settings, onnx="onnx" not in left_out, nir="nir" not in left_out), left_out


def _write_onnx(
    network: FoldedNetwork, folder: Path, specialised: tuple[str, ...], facts: dict[str, Any]
) -> dict[str, Path]:
    models: dict[str, onnx.ModelProto] = {"decision": decision_model(network)}
    if network.spiking:
        models["step"] = step_model(network)
    for task in specialised:
        models[f"decision_{file_name(task)}"] = decision_model(network, network.task_index(task))
    files = {}
    for name, model in models.items():
        for key, value in (facts | {"opset": str(OPSET)}).items():
            entry = model.metadata_props.add()
            entry.key, entry.value = key, value
        files[f"{name}.onnx"] = folder / f"{name}.onnx"
        write_atomically(files[f"{name}.onnx"], model.SerializeToString())
        (folder / f"{name}.onnx.data").unlink(missing_ok=True)  # weights of an export by another tool
    return files


def _write_nir(network: FoldedNetwork, folder: Path, dialect: NirDialect, facts: dict[str, Any]) -> dict[str, Path]:
    files = {}
    for index, task in enumerate(network.tasks):
        graph = nir_graph(network, index, dialect)
        graph.metadata.update(facts)
        path = folder / f"{file_name(task)}.nir"
        temporary = path.with_suffix(".tmp.nir")
        try:
            write_nir(graph, temporary)
            temporary.rename(path)
        finally:
            temporary.unlink(missing_ok=True)
        beside = metadata(network) | facts | {"task": task, DIALECT_KEY: dialect, "dt": graph.metadata["dt"]}
        write_atomically(path.with_suffix(".json"), json.dumps(beside, indent=1).encode())
        files[path.name] = path
    return files


def _read_back(network: FoldedNetwork, files: dict[str, Path]) -> Exports:
    """What lies on the disk; that, and nothing in memory, is compared."""
    names = network.tasks
    graphs = {name: read_nir(files[key]) for name in names if (key := f"{file_name(name)}.nir") in files}
    own = {name: files[key].read_bytes() for name in names if (key := f"decision_{file_name(name)}.onnx") in files}
    decision, step = (files[key].read_bytes() if key in files else None for key in ("decision.onnx", "step.onnx"))
    return Exports(network, decision, step, graphs or None, own)


def evaluate_exported(
    runtime: str, run: str | Path | None = None, task: str | None = None, checkpoint: str = "last", **protocol: Any
) -> tuple[Evaluation, float]:
    """Evaluate a run's exported files instead of its network; also written to ``export/evaluation_<runtime>.json``.

    Args:
        runtime: ``onnx`` (``export/decision.onnx``) or ``nir`` (``export/<task>.nir`` in the reference interpreter).
        run: run folder; None takes the newest under ``runs/``.
        task: one task's name; None evaluates all.
        checkpoint: which weights the share of equal actions refers to.
        protocol: fields of EvaluationConfig to change.

    Returns:
        The scores, and the share of greedy decisions with the trained network's action.

    Raises:
        ExportError: an unknown runtime; the run was not exported, or its files are of another training step.
    """
    folder = RunFolder(Path(run) if run is not None else latest_run()).require()
    agent = load_agent(folder.path, checkpoint, "cpu")
    suite, config = agent.suite, agent.config
    played = _runtime(folder, runtime, suite, config)
    if played.step != agent.step:
        raise ExportError(
            f"the exported files are of step {played.step}, expected {agent.step} (the {checkpoint} checkpoint); "
            f"run switchmt-snn export {folder.path} again"
        )
    compared = ComparedAgent(played, agent)
    settings = replace(config.evaluation, **protocol)
    tasks = None if task is None else (suite.names[suite.index(task)],)
    evaluation = evaluate_agent(compared, EvaluationProtocol.of(settings, config.tasks), tasks)
    decisions, equal = (sum(column) for column in zip(*compared.compared, strict=True))
    share = equal / decisions
    facts = {"runtime": runtime, "equal_actions_share": share, "decisions": decisions, **evaluation.to_dict()}
    write_atomically(folder.path / "export" / f"evaluation_{runtime}.json", json.dumps(facts, indent=1).encode())
    return evaluation, share


def load_exported(run: str | Path | None = None, runtime: str = "onnx", threads: int = 1) -> OnnxAgent | NirAgent:
    """A run's exported files as an agent: ``q_values(observations, task)`` for raw observations ``[B, ...]``.

    Args:
        run: run folder; None takes the newest under ``runs/``.
        runtime: ``onnx``, the fastest way to act on a CPU (docs/performance.md), or ``nir``.
        threads: of onnxruntime. With more than one a decision is faster, and sums may have another order.

    Raises:
        ExportError: an unknown runtime, or the run was not exported.

    Example:
        >>> import numpy as np
        >>> from switchmt_snn.export import ExportSettings, export, load_exported
        >>> exported = export("runs/mine", ExportSettings(onnx=True, parity_decisions=8))
        >>> agent = load_exported("runs/mine")
        >>> observations = np.zeros((5, *agent.suite.observation_shape), np.float32)
        >>> agent.q_values(observations, task=0).shape
        (5, 3)
    """
    folder = RunFolder(Path(run) if run is not None else latest_run()).require()
    config = folder.config()
    return _runtime(folder, runtime, make_suite(config.tasks), config, threads)


def _runtime(
    folder: RunFolder, runtime: str, suite: TaskSuite, config: ExperimentConfig, threads: int = 1
) -> OnnxAgent | NirAgent:
    if runtime == "onnx":
        return OnnxAgent(_exported(folder, "decision.onnx", "--onnx"), suite, config, threads)
    if runtime != "nir":
        raise ExportError(f"the runtime is {runtime!r}, expected onnx or nir")
    paths = {name: _exported_nir(folder, name) for name in suite.names}
    return NirAgent({name: read_nir(path) for name, path in paths.items()}, suite, config)


def _exported_nir(folder: RunFolder, task: str) -> Path:
    """The task's NIR file, also under the name that version 0.1.0 gave to a task with a slash."""
    old_name = re.sub(r"[^A-Za-z0-9_.-]", "_", task) + ".nir"
    is_old = old_name != f"{file_name(task)}.nir" and (folder.path / "export" / old_name).is_file()
    return _exported(folder, old_name if is_old else f"{file_name(task)}.nir", "--nir")


def _exported(folder: RunFolder, name: str, flag: str) -> Path:
    path = folder.path / "export" / name
    if not path.is_file():
        raise ExportError(f"no {path}, expected an exported run; run switchmt-snn export {folder.path} {flag}")
    return path
