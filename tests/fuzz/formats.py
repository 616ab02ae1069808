"""The formats that are fuzzed: good files to begin with, and what a reader must do with any mutant.

A reader takes a mutant or refuses it by one printable line (``SwitchMTError``), in ``MOST_CPU_S`` and ``MOST_BYTES``.
"""

from __future__ import annotations

import functools
import json
import resource
import signal
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from switchmt_snn.config import TasksConfig, load_config, resolve, to_yaml
from switchmt_snn.errors import SwitchMTError
from switchmt_snn.export.chips.fit import check_fit
from switchmt_snn.export.selection import Selection
from switchmt_snn.learning.training import observation_spec
from switchmt_snn.runs.checkpoint import CheckpointStore, fitting_weights
from switchmt_snn.runs.description import describe_method
from switchmt_snn.runs.files import file_name, sha256
from switchmt_snn.runs.manifest import seal
from switchmt_snn.spiking.network import QNetwork, build_network
from switchmt_snn.study.grid import load_study
from switchmt_snn.tasks.registry import make_suite
from tests.export.chip_networks import chain
from tests.fuzz.mutations import binary_mutant, json_mutant, mutant, text_mutant

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
        AssertionError: the line is not one printable line, or the memory grew too far.
        TimeoutError: it took too long.
    """
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    line = "taken"
    with _cpu_limit(MOST_CPU_S), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            FORMATS[name].read(folder, content, number)
        except SwitchMTError as error:
            refusal: SwitchMTError | None = error
        else:
            refusal = None
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
    step, state, _ = CheckpointStore(folder).load_model()
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


FORMATS = {
    "config": Format(_files("configs/*.yaml", "tests/fixtures/runs/*/config.yaml", "examples/*.yaml"), _read_config),
    "study": Format({**_files("configs/studies/*.yaml"), "grid": GRID}, _read_study),
    "target": Format(_files("export/energy/targets/*.yaml", "export/chips/builtin/*.yaml"), _read_target),
    "manifest": Format({"gym": (CHECKPOINTS["gym"] / "manifest.json").read_bytes()}, _read_manifest, json_mutant),
    "weights": Format({"gym": (CHECKPOINTS["gym"] / "model.safetensors").read_bytes()}, _read_weights, binary_mutant),
    "task-id": Format({name: name.encode() for name in TASK_IDS}, _read_task_id, _task_id_mutant),
}


def writable(folder: Path, name: str) -> None:
    """Whether a task's files can be written.

    Raises:
        OSError: they cannot.
    """
    (folder / f"{file_name(name)}.csv").write_text("")
