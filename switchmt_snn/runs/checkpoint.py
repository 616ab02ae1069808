"""Checkpoints: a folder of safetensors and JSON with a manifest of SHA-256 sums. No pickle anywhere.

    checkpoints/step-000050000/   model.safetensors  training.safetensors  state.json  manifest.json
    checkpoints/replay/           <sha256>.zst: segments of replay frames, shared by the checkpoints
    checkpoints/best/             model.safetensors  manifest.json

``model.safetensors`` is the network that acts: Q, or with ``learning.acting_network: target`` Q*. The other one is in
``training.safetensors``.

A checkpoint is written to a temporary folder and renamed, so it exists whole or not at all; the one before it is
removed only after that. Frames of a full replay segment are written once, however many checkpoints refer to them.
"""

from __future__ import annotations

import json
import math
import shlex
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import safetensors
import safetensors.torch
import torch
import zstandard

from switchmt_snn.errors import CheckpointError, reason_of, require_saved, shown
from switchmt_snn.replay.ring import FrameReplay, Segment
from switchmt_snn.runs.files import made, sha256, sync_folder, write_atomically, writing
from switchmt_snn.runs.manifest import FORMAT, read_json, read_manifest, seal
from switchmt_snn.runs.state_tree import MODEL_PREFIXES, join, split

_CONTINUED = 3
"""The oldest format that can be continued. Weights are read from any."""
_STEP_DIGITS = 12
_MODEL_FILE = "model.safetensors"


@dataclass(frozen=True)
class LoadedCheckpoint:
    """A checkpoint that was read whole.

    Attributes:
        step: agent steps of the run.
        state: what ``Training.state_dict`` gave.
        log_sizes: bytes of each log file at that moment.
        damaged: what was wrong with newer checkpoints that were passed over.
    """

    step: int
    state: dict[str, Any]
    log_sizes: dict[str, int]
    damaged: tuple[str, ...]


@dataclass(frozen=True)
class Best:
    """The best weights of a run.

    Attributes:
        step: agent steps of the run.
        score: by which they were chosen (``switchmt_snn.runs.best``).
        judged_by: ``evaluation`` or ``returns``, of training; scores of one kind cannot be compared with the other's.
    """

    step: int
    score: float
    judged_by: str


@contextmanager
def fitting_weights() -> Iterator[None]:
    """Within it, weights that do not fit the network's parameters are an error of one line.

    Raises:
        CheckpointError: a parameter is missing, unknown or of another shape.
    """
    try:
        yield
    except RuntimeError as error:
        if "loading state_dict" not in str(error):
            raise
        reason = reason_of(error)
        raise CheckpointError(
            f"the checkpoint does not fit the network ({reason:.400}), expected the parameters that it was saved with; "
            "if the code of a neuron changed, restore it, or start a new run with --run"
        ) from error


class _WeightsOnly(CheckpointError):
    """A checkpoint that was made to be read, not to be continued."""


class _Unusable(CheckpointError):
    """A checkpoint that is not damaged and yet none of ours; found when it is half read, so no other one is tried."""


class CheckpointStore:
    """The checkpoints of one run folder."""

    def __init__(self, folder: Path, keep: int = 2) -> None:
        self.folder = folder
        self.keep = keep
        self._replay_folder = folder / "replay"
        self._stored: dict[tuple[int, int, int], dict[str, Any]] = {}

    # Writing

    def save(
        self,
        step: int,
        state: dict[str, Any],
        replays: list[FrameReplay],
        log_sizes: dict[str, int],
        acting_network: str = "online",
    ) -> Path:
        """Write a checkpoint, then drop the ones that are too old.

        Args:
            step: agent steps of the run.
            state: ``Training.state_dict()``.
            replays: whose frames are stored.
            log_sizes: bytes of each log file.
            acting_network: which network becomes ``model.safetensors``, ``online`` or ``target``.

        Raises:
            WriteError: the disk is full or not writable; older checkpoints are untouched.
        """
        made(self._replay_folder)
        segments = [entry for task, replay in enumerate(replays) for entry in self._store_segments(task, replay)]
        final = self.folder / _name(step)
        if final.is_dir() and self._is_whole(final):
            return final  # saved already at this very step, and a step has one state
        model, training, tree = split(state, MODEL_PREFIXES[acting_network])
        files = {
            _MODEL_FILE: safetensors.torch.save(model),
            "training.safetensors": safetensors.torch.save(training),
            "state.json": json.dumps(tree).encode(),
        }
        facts = {"step": step, "acting_network": acting_network, "segments": segments, "logs": log_sizes}
        self._write_folder(final, files, facts)
        sync_folder(self.folder)
        self.remove_old(step)
        return final

    def save_best(self, step: int, network_state: dict[str, torch.Tensor], score: float, judged_by: str) -> None:
        """Keep these weights as the best so far (weights only)."""
        self._save_model(self.folder / "best", network_state, {"step": step, "score": score, "judged_by": judged_by})

    def save_weights(self, step: int, network_state: dict[str, torch.Tensor]) -> None:
        """Write a checkpoint that can be read but not continued: weights only."""
        self._save_model(self.folder / _name(step), network_state, {"step": step})

    def _save_model(self, final: Path, network_state: dict[str, torch.Tensor], facts: dict[str, Any]) -> None:
        model = {name: tensor.detach().cpu().contiguous() for name, tensor in network_state.items()}
        self._write_folder(final, {_MODEL_FILE: safetensors.torch.save(model)}, {**facts, "segments": [], "logs": {}})

    def best(self) -> Best | None:
        """What is known of the best weights; None if there are none."""
        try:
            manifest = read_manifest(self.folder / "best")
        except CheckpointError:
            return None
        return Best(int(manifest["step"]), float(manifest["score"]), manifest.get("judged_by", "returns"))

    def _write_folder(self, final: Path, files: dict[str, bytes], facts: dict[str, Any]) -> None:
        """Write a checkpoint's folder under a temporary name, then rename it."""
        temporary = self.folder / f".{final.name}.tmp"
        sums = {name: sha256(content) for name, content in files.items()}
        manifest = {"format": FORMAT, "program": "switchmt-snn", **facts, "files": sums}
        sealed = {**manifest, "seal": seal(manifest)}
        shutil.rmtree(temporary, ignore_errors=True)
        with writing(final, whole=True):
            try:
                temporary.mkdir(parents=True)
                for name, content in files.items():
                    write_atomically(temporary / name, content)
                write_atomically(temporary / "manifest.json", json.dumps(sealed, indent=1).encode())
                if final.exists():
                    shutil.rmtree(final)
                temporary.rename(final)
            finally:
                shutil.rmtree(temporary, ignore_errors=True)

    def _store_segments(self, task: int, replay: FrameReplay) -> Iterator[dict[str, Any]]:
        for segment in replay.segments():
            key = (task, segment.lane, segment.number)
            entry = self._stored.get(key)
            if entry is None or not segment.complete:
                content = zstandard.compress(np.ascontiguousarray(replay.read_segment(segment)).tobytes(), 3)
                digest = sha256(content)
                path = self._replay_folder / f"{digest}.zst"
                if not path.exists() or sha256(path.read_bytes()) != digest:  # absent, or damaged
                    write_atomically(path, content)
                entry = {"task": task, "lane": segment.lane, "number": segment.number, "sha256": digest}
                if segment.complete:
                    self._stored[key] = entry
            yield entry

    def remove_old(self, step: int) -> None:
        """Drop what is older than the newest ``keep`` up to the one of ``step``, and what no checkpoint refers to.

        A save does it, and whoever continues a run: a process that was killed may have left half of it. Those of a
        later step are damaged: the run went on from one before them. They count for nothing.

        Raises:
            WriteError: the system refused.
        """
        with writing(self.folder):
            self._remove_old(_name(step))

    def _remove_old(self, newest: str) -> None:
        for path in [path for path in self.paths() if path.name <= newest][self.keep :]:
            # Without its manifest a half-removed folder is no checkpoint any more.
            (path / "manifest.json").unlink(missing_ok=True)
            shutil.rmtree(path, ignore_errors=True)
        used = set()
        for path in self.paths():
            try:
                used |= {entry["sha256"] for entry in read_manifest(path)["segments"]}
            except CheckpointError:
                return  # a damaged manifest: its segments are unknown, so none is removed
        for path in [*self._replay_folder.glob("*.zst"), *self._replay_folder.glob(".*.tmp")]:
            if path.stem not in used:
                path.unlink(missing_ok=True)
        current = {key: entry for key, entry in self._stored.items() if entry["sha256"] in used}
        self._stored = current

    # Reading

    @property
    def _train_first(self) -> str:
        """What to do where there is none."""
        return f"train first: switchmt-snn train --run {shlex.quote(str(self.folder.parent))}"

    def paths(self) -> list[Path]:
        """Checkpoint folders, newest first."""
        return sorted((path for path in self.folder.glob("step-*") if path.is_dir()), reverse=True)

    def load(self, replays: list[FrameReplay]) -> LoadedCheckpoint:
        """Read the newest checkpoint that is whole; fills the replays with frames and small arrays.

        Raises:
            CheckpointError: there is none, none is whole, or the newest one holds weights only.
        """
        damaged: list[str] = []
        for path in self.paths():
            try:
                return self._load_one(path, replays, tuple(damaged))
            except (_WeightsOnly, _Unusable):
                raise
            except CheckpointError as error:
                damaged.append(f"checkpoint {path.name} is damaged ({error})")
        if damaged:
            raise CheckpointError(
                f"no whole checkpoint in {self.folder}: {'; '.join(damaged)}; expected at least one; "
                "start again in another folder with --run"
            )
        raise CheckpointError(f"no checkpoint in {self.folder}, expected one; {self._train_first}")

    def _load_one(self, path: Path, replays: list[FrameReplay], damaged: tuple[str, ...]) -> LoadedCheckpoint:
        manifest = read_manifest(path)
        if manifest["format"] < _CONTINUED:
            raise CheckpointError(
                f"format {manifest['format']} can be evaluated, but only {_CONTINUED} and later can be continued"
            )
        if list(manifest["files"]) == [_MODEL_FILE]:
            raise _WeightsOnly(
                f"{path} holds weights only (a packed run), expected a run with its replay; it can be evaluated, "
                "exported and profiled, but training needs a new run: --run NEW_FOLDER"
            )
        model = _read_tensors(path, _MODEL_FILE, manifest)
        training = _read_tensors(path, "training.safetensors", manifest)
        tree = read_json(_read_file(path, "state.json", manifest), "state.json")
        state = join(tree, model, training, MODEL_PREFIXES[manifest.get("acting_network", "online")])
        contents = [self._read_segment(entry) for entry in manifest["segments"]]
        require_saved(state, ("replays", "steps"), "the run")
        if state["steps"] != manifest["step"]:
            raise CheckpointError(f"state.json is of step {shown(state['steps'])}, expected {manifest['step']}")
        require_saved(state["replays"], map(str, range(len(replays))), "the run's replay memories")
        for task, replay in enumerate(replays):
            replay.require_fits(state["replays"][str(task)])
        _require_segments(manifest["segments"], contents, replays, state["replays"])
        # Nothing is changed before everything was read.
        for task, replay in enumerate(replays):
            replay.load_state_dict(state["replays"][str(task)])
        for entry, content in zip(manifest["segments"], contents, strict=True):
            replay, segment = replays[entry["task"]], Segment(entry["lane"], entry["number"], complete=True)
            replay.load_segment(segment, _frames(entry, content, replay))  # one by one: they may be gigabytes
        complete = {(task, s.lane, s.number) for task, r in enumerate(replays) for s in r.segments() if s.complete}
        keyed = {(entry["task"], entry["lane"], entry["number"]): entry for entry in manifest["segments"]}
        self._stored = {key: entry for key, entry in keyed.items() if key in complete}
        return LoadedCheckpoint(int(manifest["step"]), state, dict(manifest["logs"]), damaged)

    def _is_whole(self, path: Path) -> bool:
        """Whether a checkpoint and the segments it refers to can be read as they were written."""
        try:
            manifest = read_manifest(path)
            for name in manifest["files"]:
                _read_file(path, name, manifest)
            for entry in manifest["segments"]:
                self._read_segment(entry)
        except CheckpointError:
            return False
        return True

    def _read_segment(self, entry: dict[str, Any]) -> bytes:
        path = self._replay_folder / f"{entry['sha256']}.zst"
        try:
            content = path.read_bytes()
        except OSError as error:
            raise CheckpointError(f"replay segment {path.name[:12]} cannot be read") from error
        if sha256(content) != entry["sha256"]:
            raise CheckpointError(f"replay segment {path.name[:12]} has another checksum")
        return content

    def load_model(self, which: str = "last") -> tuple[int, dict[str, torch.Tensor]]:
        """Step and weights of the last checkpoint, or of the best one.

        Raises:
            CheckpointError: ``which`` is neither ``last`` nor ``best``, there is no such checkpoint, or it is damaged.
                An older one never takes its place: a score would be of other weights than its reader thinks.
        """
        if which not in ("last", "best"):
            raise CheckpointError(f"the checkpoint is {which!r}, expected last or best")
        paths = [self.folder / "best"] if which == "best" else self.paths()
        seen, remedy = "none", self._train_first
        if paths:
            try:
                manifest = read_manifest(paths[0])
                return int(manifest["step"]), _read_tensors(paths[0], _MODEL_FILE, manifest)
            except CheckpointError as error:
                if paths[0].exists():
                    seen = f"checkpoint {paths[0].name} is damaged ({error})"
                if which == "best":
                    remedy = "use --checkpoint last"
                else:
                    remedy = (
                        "continue the run: training begins at the one before it; or remove this one to use that one"
                    )
                    if len(paths) == 1:
                        remedy = "it is the only one; train again in another folder"
        raise CheckpointError(f"no whole {which} checkpoint in {self.folder} ({seen}), expected one; {remedy}")


def _name(step: int) -> str:
    return f"step-{step:0{_STEP_DIGITS}d}"


def _read_file(path: Path, name: str, manifest: dict[str, Any]) -> bytes:
    try:
        content = (path / name).read_bytes()
    except OSError as error:
        raise CheckpointError(f"{name} cannot be read") from error
    if sha256(content) != manifest["files"].get(name):
        raise CheckpointError(f"{name} has another checksum")
    return content


def _read_tensors(path: Path, name: str, manifest: dict[str, Any]) -> dict[str, torch.Tensor]:
    content = _read_file(path, name, manifest)
    try:
        tensors: dict[str, torch.Tensor] = safetensors.torch.load(content)
    except (safetensors.SafetensorError, KeyError, ValueError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{name} is not a safetensors file") from error
    if name == _MODEL_FILE:
        for key, tensor in tensors.items():
            if not bool(torch.isfinite(tensor.to(torch.float32)).all()):  # wider numbers would not fit a weight
                raise CheckpointError(f"{key} in {name} has a number that is not finite, expected finite weights")
    return tensors


def _require_segments(
    entries: list[dict[str, Any]], contents: list[bytes], replays: list[FrameReplay], states: dict[str, Any]
) -> None:
    """Refuse stored segments that are not just those that the replays' states refer to, or of another size.

    Raises:
        CheckpointError: naming the segment.
    """
    expected = {
        (task, *key): frames
        for task, replay in enumerate(replays)
        for key, frames in replay.segments_of(states[str(task)]).items()
    }
    keys = [(entry["task"], entry["lane"], entry["number"]) for entry in entries]
    if sorted(keys) != sorted(expected):
        raise CheckpointError(f"its {len(keys)} replay segments are not the {len(expected)} that its state refers to")
    for key, entry, content in zip(keys, entries, contents, strict=True):
        number = f"replay segment {entry['sha256'][:12]}"
        replay = replays[entry["task"]]
        needed = expected[key] * math.prod(replay.frame_shape) * replay.frame_dtype.itemsize
        try:
            size = zstandard.frame_content_size(content)
        except zstandard.ZstdError as error:
            raise CheckpointError(f"{number} is not Zstandard") from error
        if size != needed:
            raise CheckpointError(f"{number} declares {size:,} bytes, expected {needed:,}")


def _frames(entry: dict[str, Any], content: bytes, replay: FrameReplay) -> npt.NDArray[Any]:
    """The frames of a stored segment whose checksum and declared size are right.

    Raises:
        _Unusable: it is no Zstandard all the same, or holds numbers that are not finite.
    """
    number = f"replay segment {entry['sha256'][:12]}"
    try:
        frames = np.frombuffer(zstandard.decompress(content), replay.frame_dtype).reshape(-1, *replay.frame_shape)
    except zstandard.ZstdError as error:
        raise _Unusable(f"{number} is not Zstandard, expected frames; start a new run with --run") from error
    if replay.frame_dtype.kind == "f" and not np.isfinite(frames).all():
        raise _Unusable(f"{number} has a number that is not finite, expected finite frames; start a new run with --run")
    return frames
