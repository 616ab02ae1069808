"""The formats that are fuzzed: good files to begin with, and what a reader must do with any mutant.

A reader takes a mutant or refuses it by one printable line (``SwitchMTError``), in ``MOST_CPU_S`` and ``MOST_BYTES``.
"""

from __future__ import annotations

import functools
import io
import json
import random
import resource
import shutil
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.numpy
import torch
import zstandard

from switchmt_snn.config import ExperimentConfig, TasksConfig, load_config, resolve, to_yaml
from switchmt_snn.errors import SwitchMTError
from switchmt_snn.export.chips.fit import check_fit
from switchmt_snn.export.recording import read_recording
from switchmt_snn.export.selection import Selection
from switchmt_snn.learning.events import Stepped
from switchmt_snn.learning.parts import observation_spec
from switchmt_snn.learning.training import Training
from switchmt_snn.runs.checkpoint import CheckpointStore, fitting_weights
from switchmt_snn.runs.description import describe_method
from switchmt_snn.runs.files import file_name, sha256
from switchmt_snn.runs.folder import RunFolder
from switchmt_snn.runs.listing import list_runs, summarize
from switchmt_snn.runs.manifest import seal
from switchmt_snn.spiking.network import QNetwork, build_network
from switchmt_snn.study.grid import load_study
from switchmt_snn.study.replayed import replay_policies
from switchmt_snn.tasks.registry import make_suite
from switchmt_snn.viewing.report.page import write_report
from tests.export.chip_networks import chain
from tests.fuzz.exported import nir_mutant, nir_seeds, onnx_mutant, onnx_seeds, read_nir_file, read_onnx
from tests.fuzz.mutations import (
    TEXT_CHANGES,
    array_mutant,
    binary_mutant,
    change_value,
    json_mutant,
    mutant,
    text_mutant,
)

ROOT = Path(__file__).parents[2]
MOST_CPU_S = 10.0
MOST_BYTES = 2**30
DESCRIBED = 16
"""One of so many mutants of a config is also built, as ``describe`` does; building takes the most time."""
TASK_IDS = (
    "CartPole-v1", "CartPole-v0", "ALE/Pong-v5", "no_such_module:MyEnv-v0", "tests.tasks.odd_envs:Plain-v0",
    "tests.tasks.odd_envs:nested/Plain-v0", "phys2d/CartPole-v1", ".:x", ":x-v0", "../x:y", "a:b:c", ":::",
)  # fmt: skip


@dataclass(frozen=True)
class Format:
    """One format.

    Attributes:
        seeds: good contents, by name.
        read: takes a folder to write to, a mutant and its seed; raises ``SwitchMTError`` if it refuses.
        mutate: makes a mutant.
    """

    seeds: dict[str, bytes]
    read: Callable[[Path, bytes, int], None]
    mutate: Callable[[bytes, int], bytes] = mutant


def mutant_of(name: str, number: int) -> bytes:
    """The mutant of a format with a number; its seed file goes round."""
    form = FORMATS[name]
    good = list(form.seeds.values())
    return form.mutate(good[number % len(good)], number)


def outcome(name: str, folder: Path, content: bytes, number: int = 0) -> str:
    """What a format's reader does with a mutant: ``taken``, or the line by which it refuses.

    Raises:
        AssertionError: the line is not one printable line, something was printed, or the memory grew too far.
        TimeoutError: it took too long.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    line = "taken"
    said = io.StringIO()
    with _cpu_limit(MOST_CPU_S), warnings.catch_warnings(), redirect_stdout(said):
        warnings.simplefilter("ignore")
        try:
            FORMATS[name].read(folder, content, number)
        except SwitchMTError as error:
            refusal: SwitchMTError | None = error
        else:
            refusal = None
    assert said.getvalue() == "", f"a library printed {said.getvalue()!r:.200}"
    if refusal is not None:
        line = str(refusal).replace(str(folder), "FOLDER")
        assert refusal.exit_code == 2, line
        assert line.isprintable(), ascii(line)
        assert len(line) < 2000, line
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024
    assert grown < MOST_BYTES, f"the memory grew by {grown:,} bytes"
    return line


@contextmanager
def _cpu_limit(seconds: float) -> Iterator[None]:
    """Raise TimeoutError after so many seconds of this process's processor time (a busy machine is no hang)."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"more than {seconds:g} s")

    previous = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, previous)


def _read_config(folder: Path, content: bytes, number: int) -> None:
    path = folder / "mutant.yaml"
    path.write_bytes(content)
    config = load_config(path)
    resolved = resolve(config)
    path.write_text(to_yaml(resolved, config))
    assert load_config(path, reopen=False) == resolved, "it does not read back as it was written"
    if number % DESCRIBED == 0 and not any(":" in name for name in resolved.tasks.names):
        describe_method(resolved, make_suite(resolved.tasks))


def _read_study(folder: Path, content: bytes, number: int) -> None:
    path = folder / "mutant.yaml"
    path.write_bytes(content)
    study = load_study(path)
    assert len({trial.name for trial in study.trials}) == len(study.trials)
    for trial in study.trials[:20]:
        (folder / trial.name).touch()
        resolve(trial.config)


def _read_target(folder: Path, content: bytes, number: int) -> None:
    path = folder / "mutant.yaml"
    path.write_bytes(content)
    for chip in Selection.of(path).chips:
        check_fit(chain((2, 34, 34), 10, 4), chip)


def _read_task_id(folder: Path, content: bytes, number: int) -> None:
    name = content.decode()
    tasks = make_suite(TasksConfig(suite="gym", names=(name,)))
    assert tasks.names == (name,)


def _task_id_mutant(good: bytes, seed: int) -> bytes:
    return text_mutant(good.decode(), seed).encode()


def _files(*patterns: str) -> dict[str, bytes]:
    paths = [path for pattern in patterns for path in sorted(ROOT.glob(pattern))]
    return {path.name: path.read_bytes() for path in paths}


GRID = b"""# A grid
base: classic
name: grid
settings: {network: {timesteps: 2}, total_steps: 500}
variants: {both: {}, alone: {tasks.names: [CartPole-v1], evaluation.stop_at_returns: []}}
vary: {switching.policy: [interleave, fixed_steps], learning.learning_rate: [1e-4, 0.01]}
seeds: [3, 1]
references: {CartPole-v1: 500, Acrobot-v1: -100.5}
baseline: both_policy-interleave_learning_rate-1e-4
"""
"""A study with every key."""
CHECKPOINTS = {
    path.parent.parent.parent.name: path.parent
    for path in sorted(ROOT.glob("tests/fixtures/runs/*/checkpoints/step-*/manifest.json"))
}
"""A checkpoint of each stored run."""


@functools.cache
def _network() -> QNetwork:
    """The network of the stored run whose weights are fuzzed."""
    config = resolve(load_config(ROOT / "tests/fixtures/runs/gym/config.yaml"))
    return build_network(config.network, observation_spec(make_suite(config.tasks)), config.seed)


def _read_checkpoint(folder: Path, manifest: bytes, weights: bytes) -> None:
    """Read the weights of a checkpoint as ``load_agent`` does."""
    checkpoint = folder / "step-000000000400"
    checkpoint.mkdir(exist_ok=True)
    (checkpoint / "manifest.json").write_bytes(manifest)
    (checkpoint / "model.safetensors").write_bytes(weights)
    step, state = CheckpointStore(folder).load_model()
    assert step >= 0
    with fitting_weights():
        _network().load_state_dict(state)
    assert all(bool(tensor.isfinite().all()) for tensor in _network().state_dict().values())


def _read_manifest(folder: Path, content: bytes, number: int) -> None:
    """A manifest whose seal was made to fit, beside good weights."""
    try:
        data = json.loads(content)
        if isinstance(data, dict):
            data.pop("seal", None)
            content = json.dumps({**data, "seal": seal(data)}).encode()
    except (ValueError, RecursionError):
        pass
    _read_checkpoint(folder, content, (CHECKPOINTS["gym"] / "model.safetensors").read_bytes())


def _read_weights(folder: Path, content: bytes, number: int) -> None:
    """Weights whose checksums were made to fit."""
    manifest = json.loads((CHECKPOINTS["gym"] / "manifest.json").read_bytes())
    del manifest["seal"]
    manifest["files"]["model.safetensors"] = sha256(content)
    _read_checkpoint(folder, json.dumps({**manifest, "seal": seal(manifest)}).encode(), content)


@functools.cache
def _gym_run() -> ExperimentConfig:
    return resolve(load_config(ROOT / "tests/fixtures/runs/gym/config.yaml"))


def _continue(folder: Path, changed: str, content: bytes) -> None:
    """Continue the stored run with one of its files changed and all checksums made to fit, for a few steps."""
    source = CHECKPOINTS["gym"]
    checkpoint, replay = folder / source.name, folder / "replay"
    for made in (checkpoint, replay):
        made.mkdir(exist_ok=True)
    manifest = json.loads((source / "manifest.json").read_bytes())
    del manifest["seal"]
    for entry in manifest["segments"]:
        name = f"{entry['sha256']}.zst"
        whole = (source.parent / "replay" / name).read_bytes()
        if name == changed:
            whole, entry["sha256"] = content, sha256(content)
        (replay / f"{entry['sha256']}.zst").write_bytes(whole)
    for name in manifest["files"]:
        whole = content if name == changed else (source / name).read_bytes()
        manifest["files"][name] = sha256(whole)
        (checkpoint / name).write_bytes(whole)
    (checkpoint / "manifest.json").write_text(json.dumps({**manifest, "seal": seal(manifest)}))
    suite = make_suite(_gym_run().tasks)
    training = Training(_gym_run(), suite, torch.device("cpu"))
    try:
        loaded = CheckpointStore(folder).load(training.replays)
        with fitting_weights():
            training.load_state_dict(loaded.state)
        for event in training.events():
            if isinstance(event, Stepped) and event.step > loaded.step + 12:
                break
        training.check_finite()
    finally:
        training.close()
        shutil.rmtree(replay)


def _read_state(folder: Path, content: bytes, number: int) -> None:
    _continue(folder, "state.json", content)


def _read_training(folder: Path, content: bytes, number: int) -> None:
    _continue(folder, "training.safetensors", content)


SEGMENT = min(ROOT.glob("tests/fixtures/runs/gym/checkpoints/replay/*.zst"))


def _read_segment(folder: Path, content: bytes, number: int) -> None:
    _continue(folder, SEGMENT.name, content)


def _segment_mutant(good: bytes, seed: int) -> bytes:
    """Frames of any kind that are whole, or damaged bytes."""
    rng = random.Random(seed)
    if rng.random() < 0.5:
        return binary_mutant(good, seed)
    return zstandard.compress(binary_mutant(zstandard.decompress(good), seed))


STORED_RUN = ROOT / "tests/fixtures/runs/gym"
REPORTED = 8
"""One of so many mutants of a log also makes the run's page."""


def _read_log(changed: str) -> Callable[[Path, bytes, int], None]:
    """A reader of one log of a run: as runs, replay-policies and report read it."""

    def read(folder: Path, content: bytes, number: int) -> None:
        run = folder / "run"
        if not run.exists():
            shutil.copytree(STORED_RUN, run, ignore=shutil.ignore_patterns("recordings", "export", "replay"))
        path = run / changed
        good = path.read_bytes()
        path.write_bytes(content)
        try:
            listed, damaged = list_runs(folder)
            assert len(listed) + len(damaged) == 1
            summarize(run)
            replay_policies(RunFolder(run)).to_dict()
            if number % REPORTED == 0:
                write_report([run])
        finally:
            path.write_bytes(good)

    return read


def _line_mutant(good: bytes, seed: int) -> bytes:
    """A mutant of a file of lines: of its values, its lines or its bytes."""
    rng = random.Random(seed)
    content = good
    for _ in range(rng.choice((1, 1, 2, 3))):
        content = rng.choice((change_value, change_value, change_value, *TEXT_CHANGES))(content, rng)
    return content


EVALUATION = "evaluations/step-000000000400_Acrobot-v1+CartPole-v1_n2_seed10000.json"


def _read_recording(folder: Path, content: bytes, number: int) -> None:
    """Recorded play, as export and profile read it."""
    path = folder / "mutant-step-400.npz"
    path.write_bytes(content)
    suite = make_suite(_gym_run().tasks)
    recording = read_recording(path, "CartPole-v1", suite)
    assert np.isfinite(recording.observations).all()
    assert set(recording.actions.tolist()) <= {0, 1}


def _npz_mutant(good: bytes, seed: int) -> bytes:
    """An archive with other arrays, or with damaged bytes."""
    rng = random.Random(seed)
    if rng.random() < 0.4:
        return binary_mutant(good, seed)
    with np.load(io.BytesIO(good)) as archive:
        arrays = dict(archive)
    name = rng.choice(sorted(arrays))
    arrays[name] = array_mutant(arrays[name], rng)
    if arrays[name] is None:
        del arrays[name]
    content = io.BytesIO()
    rng.choice((np.savez, np.savez_compressed))(content, **arrays)
    return binary_mutant(content.getvalue(), seed) if rng.random() < 0.2 else content.getvalue()


def _tensors_mutant(good: bytes, seed: int) -> bytes:
    """Tensors of other shapes, types, names or values, or damaged bytes."""
    rng = random.Random(seed)
    if rng.random() < 0.2:
        return binary_mutant(good, seed)
    tensors = safetensors.numpy.load(good)
    for name in rng.sample(sorted(tensors), rng.choice((1, 1, 2))):
        changed = array_mutant(tensors[name], rng)
        if changed is None or changed.dtype.kind not in "biuf":
            del tensors[name]
        else:
            tensors[name] = np.ascontiguousarray(changed)
    return safetensors.numpy.save(tensors)


FORMATS = {
    "config": Format(_files("configs/*.yaml", "tests/fixtures/runs/*/config.yaml", "examples/*.yaml"), _read_config),
    "study": Format({**_files("configs/studies/*.yaml"), "grid": GRID}, _read_study),
    "target": Format(_files("export/energy/targets/*.yaml", "export/chips/builtin/*.yaml"), _read_target),
    "manifest": Format({"gym": (CHECKPOINTS["gym"] / "manifest.json").read_bytes()}, _read_manifest, json_mutant),
    "weights": Format({"gym": (CHECKPOINTS["gym"] / "model.safetensors").read_bytes()}, _read_weights, binary_mutant),
    "state": Format({"gym": (CHECKPOINTS["gym"] / "state.json").read_bytes()}, _read_state, json_mutant),
    "training": Format(
        {"gym": (CHECKPOINTS["gym"] / "training.safetensors").read_bytes()}, _read_training, _tensors_mutant
    ),
    **{
        name: Format({"gym": (STORED_RUN / file).read_bytes()}, _read_log(file), _line_mutant)
        for name, file in (
            ("episodes", "episodes.csv"),
            ("switches", "switches.csv"),
            ("metrics", "metrics.jsonl"),
            ("environment", "environment.json"),
        )
    },
    "evaluation": Format({"gym": (STORED_RUN / EVALUATION).read_bytes()}, _read_log(EVALUATION), json_mutant),
    "onnx": Format(onnx_seeds(), read_onnx, onnx_mutant),
    "nir": Format(nir_seeds(), read_nir_file, nir_mutant),
    "recording": Format(_files("tests/fixtures/runs/gym/recordings/CartPole*.npz"), _read_recording, _npz_mutant),
    "segment": Format({"gym": SEGMENT.read_bytes()}, _read_segment, _segment_mutant),
    "task-id": Format({name: name.encode() for name in TASK_IDS}, _read_task_id, _task_id_mutant),
}


def writable(folder: Path, name: str) -> None:
    """Whether a task's files can be written.

    Raises:
        OSError: they cannot.
    """
    (folder / f"{file_name(name)}.csv").write_text("")
