"""Export a run: write the files, then prove them against the trained network. Used by the command line and Python."""

from __future__ import annotations

import re
import shlex
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import nir
import numpy.typing as npt
import onnx
import onnxruntime

from switchmt_snn.acting.agent import Agent
from switchmt_snn.acting.evaluation import Evaluation, EvaluationProtocol, evaluate_agent
from switchmt_snn.config import ExperimentConfig
from switchmt_snn.errors import ConfigError, ExportError, ParityError
from switchmt_snn.export.folded import fold_agent, metadata
from switchmt_snn.export.formats.files import nir_graphs, onnx_models
from switchmt_snn.export.formats.nir_writer import DIALECT_KEY, NirDialect, dialect_of, write_nir
from switchmt_snn.export.formats.onnx_graph import OPSET
from switchmt_snn.export.parity.compare import Exports
from switchmt_snn.export.parity.proof import prove
from switchmt_snn.export.provenance import provenance
from switchmt_snn.export.recording import Recording, recorded_plays
from switchmt_snn.export.runtimes.agents import ComparedAgent, NirAgent, OnnxAgent, onnx_session, read_nir
from switchmt_snn.export.runtimes.guarded import read_file
from switchmt_snn.machine.torch_settings import as_when_started
from switchmt_snn.runs.evaluations import evaluation_name
from switchmt_snn.runs.files import file_name, json_text, made, parsed_json, sha256, write_atomically
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.model_card import CARD, model_card
from switchmt_snn.runs.packing import open_run
from switchmt_snn.runs.random_play import RandomPlay
from switchmt_snn.runs.trained import load_agent
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
        unroll: also ``unrolled.onnx``: ``decision.onnx`` without Scan, for OpenVINO, tract and OpenCV.
        int8: store the weights as 8-bit integers with one step per output channel.
        nir_dialect: see ``switchmt_snn.export.formats.nir_writer``.
        parity_decisions: recorded decisions per task that the files are compared on.
    """

    onnx: bool = False
    nir: bool = False
    tasks: tuple[str, ...] = ()
    unroll: bool = False
    int8: bool = False
    nir_dialect: NirDialect = "portable"
    parity_decisions: int = 1000


@as_when_started()
def export(
    run: str | Path | None = None,
    settings: ExportSettings | None = None,
    checkpoint: str = "last",
    out: str | Path | None = None,
    note: Note = lambda text: None,
) -> ExportResult:
    """Write a run's network as ONNX and NIR files, check them, and say in ``MODEL_CARD.md`` what they are.

    Args:
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
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
    if (settings.tasks or settings.unroll) and settings.nir and not settings.onnx:
        option, file = ("--task", "decision_TASK.onnx") if settings.tasks else ("--unroll", "unrolled.onnx")
        raise ConfigError(f"{option} writes {file}, expected --onnx with it (--nir writes every task); add --onnx")
    run_folder = open_run(run)
    agent = load_agent(run_folder.path, checkpoint, "cpu")
    specialised = tuple(agent.suite.names[agent.suite.index(task)] for task in settings.tasks)
    network = fold_agent(agent)
    exported = quantized(network) if settings.int8 else network
    started = time.perf_counter()
    built = _built(exported, settings, specialised)
    for name, reason in built.left_out.items():
        note(f"left out {name.upper()}: {reason}")
    run_folder = open_run(run_folder.path, to_write=True)
    folder = made(Path(out) if out is not None else run_folder.path / "export", "--out")
    facts = provenance(run_folder.path) | {"weights": "int8" if settings.int8 else "float32"}
    for name in ("parity.json", CARD):  # of the files that are replaced now
        (folder / name).unlink(missing_ok=True)
    files = _write_onnx(built.models, folder, facts) | _write_nir(built.graphs, exported, folder, facts)
    for name, path in files.items():
        note(f"wrote {path} ({name})")
    written_at = time.perf_counter()
    note("parity: comparing the files with the trained network on recorded play")
    try:
        parity = _compared(agent, run_folder, _read_back(exported, files), settings.parity_decisions)
    except BaseException:
        for path in files.values():  # nothing stays that was not compared
            for written in (path, path.with_suffix(".json")):
                written.unlink(missing_ok=True)
        raise
    parity["wall_s"] = {"write": written_at - started, "record_and_compare": time.perf_counter() - written_at}
    parity["left_out"] = built.left_out
    parity["files"] = {path.name: sha256(path.read_bytes()) for path in files.values()}
    write_atomically(folder / "parity.json", json_text(facts | parity, indent=1).encode())
    if parity["dyadic_skipped"] is not None:
        note(f"the exact check was left out: {parity['dyadic_skipped']}")
    if parity["failures"]:
        raise ParityError(
            f"parity failed: {'; '.join(parity['failures'])}; expected the trained network's decisions; see "
            f"{folder / 'parity.json'}"
        )
    beside = {path.name: path for file in files.values() if (path := file.with_suffix(".json")).is_file()}
    card = model_card(run_folder, checkpoint, files | beside | {"parity.json": folder / "parity.json"}, facts | parity)
    write_atomically(folder / CARD, card.encode())
    note(f"wrote {folder / CARD}")
    return ExportResult(folder, files, parity, built.left_out)


@dataclass(frozen=True)
class _Built:
    """What will be written: ONNX models by file name, NIR graphs by task, and why a format is left out."""

    models: dict[str, onnx.ModelProto]
    graphs: dict[str, nir.NIRGraph]
    left_out: dict[str, str]


def _built(network: FoldedNetwork, settings: ExportSettings, specialised: tuple[str, ...]) -> _Built:
    """Every model and graph, before anything is on the disk; if no format was asked for, those of every one that fits.

    Raises:
        ExportError: a format that was asked for does not fit (an option of ONNX asks for ONNX), or none does.
    """
    chosen = settings.onnx or settings.nir
    models: dict[str, onnx.ModelProto] = {}
    graphs: dict[str, nir.NIRGraph] = {}
    left_out: dict[str, str] = {}
    if settings.onnx or not chosen:
        try:
            models = onnx_models(network, specialised, settings.unroll)
        except ExportError as error:
            if chosen or specialised or settings.unroll:
                raise
            left_out["onnx"] = str(error)
    if settings.nir or not chosen:
        try:
            graphs = nir_graphs(network, settings.nir_dialect)
        except ExportError as error:
            if chosen:
                raise
            left_out["nir"] = str(error)
    if not models and not graphs:
        raise ExportError(". ".join(left_out.values()))
    return _Built(models, graphs, left_out)


def _compared(agent: Agent, run: RunFolder, written: Exports, decisions: int) -> dict[str, Any]:
    """What ``prove`` says about files on recorded play, and how that was played."""
    recordings: list[Recording] = []

    def arriving() -> Iterator[npt.NDArray[Any]]:
        for recording in recorded_plays(agent, run.path / "recordings", decisions):
            recordings.append(recording)
            yield recording.observations

    parity = prove(agent, written, arriving())
    protocol = {r.task: {"decisions": len(r.actions), "epsilon": r.epsilon, "seed": r.seed} for r in recordings}
    return parity | {"protocol": protocol}


def _write_onnx(models: dict[str, onnx.ModelProto], folder: Path, facts: dict[str, Any]) -> dict[str, Path]:
    files = {}
    for name, model in models.items():
        for key, value in (facts | {"opset": str(OPSET)}).items():
            entry = model.metadata_props.add()
            entry.key, entry.value = key, value
        files[name] = folder / name
        write_atomically(files[name], model.SerializeToString())
        (folder / f"{name}.data").unlink(missing_ok=True)  # weights of an export by another tool
    return files


def _write_nir(
    graphs: dict[str, nir.NIRGraph], network: FoldedNetwork, folder: Path, facts: dict[str, Any]
) -> dict[str, Path]:
    files = {}
    for task, graph in graphs.items():
        graph.metadata.update(facts)
        path = folder / f"{file_name(task)}.nir"
        write_nir(graph, path)
        beside = metadata(network) | facts | {"task": task, DIALECT_KEY: dialect_of(graph), "dt": graph.metadata["dt"]}
        write_atomically(path.with_suffix(".json"), json_text(beside, indent=1).encode())
        files[path.name] = path
    return files


def _read_back(network: FoldedNetwork, files: dict[str, Path]) -> Exports:
    """What lies on the disk; that, and nothing in memory, is compared."""
    names = network.tasks
    graphs = {name: read_nir(files[key]) for name in names if (key := f"{file_name(name)}.nir") in files}
    own = {name: files[key].read_bytes() for name in names if (key := f"decision_{file_name(name)}.onnx") in files}
    decision, step, unrolled = (
        files[key].read_bytes() if key in files else None for key in ("decision.onnx", "step.onnx", "unrolled.onnx")
    )
    return Exports(network, decision, step, graphs or None, own, unrolled)


@as_when_started()
def evaluate_exported(
    runtime: str, run: str | Path | None = None, task: str | None = None, checkpoint: str = "last", **protocol: Any
) -> tuple[Evaluation, float]:
    """Evaluate a run's exported files instead of its network; also written to ``export/evaluations/``.

    Args:
        runtime: ``onnx`` (``export/decision.onnx``) or ``nir`` (``export/<task>.nir`` in the reference interpreter).
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
        task: one task's name; None evaluates all.
        checkpoint: which weights the share of equal actions refers to.
        protocol: fields of EvaluationConfig to change.

    Returns:
        The scores, and the share of greedy decisions with the trained network's action.

    Raises:
        ExportError: an unknown runtime; the run was not exported, or its files are of another training step.
    """
    folder = open_run(run)
    agent = load_agent(folder.path, checkpoint, "cpu")
    suite, config = agent.suite, agent.config
    played = exported_as(agent, folder, runtime, checkpoint)
    compared = ComparedAgent(played, agent)
    settings = replace(config.evaluation, **protocol)
    tasks = None if task is None else (suite.names[suite.index(task)],)
    conditions = EvaluationProtocol.of(settings, config.tasks, agent.step)
    folder = open_run(folder.path, to_write=True)
    known = RandomPlay(folder.path, config, suite, conditions)
    evaluation = evaluate_agent(compared, conditions, tasks, random_play=known)
    decisions, equal = (sum(column) for column in zip(*compared.compared, strict=True))
    share = equal / decisions
    facts = {"runtime": runtime, "equal_actions_share": share, "decisions": decisions, **evaluation.to_dict()}
    path = folder.path / "export" / "evaluations" / f"{runtime}_{evaluation_name(evaluation)}.json"
    made(path.parent)
    write_atomically(path, json_text(facts, indent=1).encode())
    return evaluation, share


def exported_as(agent: Agent, folder: RunFolder, runtime: str, checkpoint: str) -> OnnxAgent | NirAgent:
    """A run's exported files as an agent, if they have the weights of the trained one.

    Raises:
        ExportError: an unknown runtime; the run was not exported, or its files are of another training step.
    """
    played = _runtime(folder, runtime, agent.suite, agent.config, checkpoint)
    if played.step != agent.step:
        raise ExportError(
            f"the exported files are of step {played.step}, expected {agent.step} (the {checkpoint} checkpoint); "
            f"export it: {_export_command(folder, checkpoint)}"
        )
    return played


def step_session(folder: RunFolder, checkpoint: str = "last") -> onnxruntime.InferenceSession:
    """``step.onnx`` of a run: one simulation step, with its spikes.

    Raises:
        ExportError: the run was not exported.
    """
    return onnx_session(_exported(folder, "step.onnx", "--onnx", checkpoint))


def load_exported(run: str | Path | None = None, runtime: str = "onnx", threads: int = 1) -> OnnxAgent | NirAgent:
    """A run's exported files as an agent: ``q_values(observations, task)`` for raw observations ``[B, ...]``.

    Args:
        run: run folder, or ``pretrained/NAME``; None takes the newest run under ``runs/``.
        runtime: ``onnx``, the fastest way to act on a CPU (docs/performance.md), or ``nir``.
        threads: of onnxruntime. With more than one a decision is faster, and sums may have another order.

    Raises:
        ExportError: an unknown runtime, or the run was not exported.

    Examples:
        >>> import numpy as np
        >>> from switchmt_snn.export import ExportSettings, export, load_exported
        >>> exported = export("runs/mine", ExportSettings(onnx=True, parity_decisions=8))
        >>> agent = load_exported("runs/mine")
        >>> observations = np.zeros((5, *agent.suite.observation_shape), np.float32)
        >>> agent.q_values(observations, task=0).shape
        (5, 3)
    """
    folder = open_run(run)
    config = folder.config()
    return _runtime(folder, runtime, make_suite(config.tasks), config, "last", threads)


def _runtime(
    folder: RunFolder, runtime: str, suite: TaskSuite, config: ExperimentConfig, checkpoint: str, threads: int = 1
) -> OnnxAgent | NirAgent:
    if runtime == "onnx":
        return OnnxAgent(_exported(folder, "decision.onnx", "--onnx", checkpoint), suite, config, threads)
    if runtime != "nir":
        raise ExportError(f"the runtime is {runtime!r}, expected onnx or nir")
    paths = {name: _exported_nir(folder, name, checkpoint) for name in suite.names}
    return NirAgent({name: read_nir(path) for name, path in paths.items()}, suite, config)


def _exported_nir(folder: RunFolder, task: str, checkpoint: str) -> Path:
    """The task's NIR file, also under the name that version 0.1.0 gave to a task with a slash."""
    old_name = re.sub(r"[^A-Za-z0-9_.-]", "_", task) + ".nir"
    is_old = old_name != f"{file_name(task)}.nir" and (folder.path / "export" / old_name).is_file()
    return _exported(folder, old_name if is_old else f"{file_name(task)}.nir", "--nir", checkpoint)


def _export_command(folder: RunFolder, checkpoint: str, *flags: str) -> str:
    chosen = () if checkpoint == "last" else ("--checkpoint", checkpoint)
    return shlex.join(["switchmt-snn", "export", str(folder.path), *flags, *chosen])


def _exported(folder: RunFolder, name: str, flag: str, checkpoint: str) -> Path:
    """A file of the run's export, as it was when it was compared with the network.

    Args:
        folder: of the run.
        name: of the file.
        flag: of ``export`` that writes it.
        checkpoint: whose weights are asked for.

    Raises:
        ExportError: it is missing, was not compared, or has changed since.
    """
    path = folder.path / "export" / name
    again = f"export it: {_export_command(folder, checkpoint, flag)}"
    if not path.is_file():
        raise ExportError(f"no {path}, expected an exported run; {again}")
    beside = path.with_name("parity.json")
    try:
        parity = parsed_json(read_file(beside, "what export compared"))
        files = parity.get("files", {})
        # Exports from before the sums were kept have none.
        unchanged = "files" not in parity or files.get(name) == sha256(read_file(path, "an exported file"))
    except (ExportError, ValueError, AttributeError) as error:
        raise ExportError(f"{beside} cannot be read, expected what export compared; {again}") from error
    if not unchanged:
        raise ExportError(f"{path} is not the file that export compared (another checksum), expected that one; {again}")
    return path
