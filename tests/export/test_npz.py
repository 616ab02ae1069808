"""Recordings of strangers: whatever an .npz file holds, it is read or refused by one line."""

from __future__ import annotations

import io
import struct
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from switchmt_snn.errors import ExportError
from switchmt_snn.export import recording
from switchmt_snn.export.npz import read_npz
from switchmt_snn.export.runtimes.agents import require_numbers
from tests.conftest import CountingEnvironment, vector_suite

SUITE = vector_suite(lambda task, num_envs: CountingEnvironment(task, num_envs, 5), 4, num_actions=3)
GOOD: dict[str, Any] = {
    "observations": np.arange(32, dtype=np.float32).reshape(8, 4),
    "actions": np.arange(8) % 3,
    "rewards": np.arange(8) - 0.5,
    "first_action": np.asarray(0),
    "epsilon": np.asarray(0.05),
    "seed": np.asarray(7),
}


def saved(path: Path, **changes: Any) -> Path:
    np.savez_compressed(path, **{key: value for key, value in {**GOOD, **changes}.items() if value is not None})
    return path


def test_a_good_recording_is_read(tmp_path: Path) -> None:
    read = recording.read_recording(saved(tmp_path / "a.npz"), "a", SUITE)
    assert np.array_equal(read.observations, GOOD["observations"])
    assert read.actions.tolist() == GOOD["actions"].tolist()
    assert read.rewards is not None
    assert read.rewards.tolist() == GOOD["rewards"].tolist()
    assert recording.read_recording(saved(tmp_path / "old.npz", rewards=None), "a", SUITE).rewards is None
    assert (read.epsilon, read.seed, read.actions.dtype) == (0.05, 7, np.int64)
    fortran = saved(tmp_path / "f.npz", observations=np.asfortranarray(GOOD["observations"]))
    assert np.array_equal(recording.read_recording(fortran, "a", SUITE).observations, GOOD["observations"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"actions": np.full(8, 3)}, r"has the action 3, expected one of \[0, 1, 2\], which a has"),
        ({"actions": np.full(8, -1)}, "has the action -1, expected one of"),
        ({"actions": np.full(8, 2**62)}, "has the action 4611686018427387904"),
        ({"actions": np.zeros(8)}, "actions of shape .8,. and type float64, expected .*whole numbers"),
        ({"actions": np.array(["up"] * 8)}, "actions has values of type <U2, expected numbers"),
        ({"actions": np.array([{}] * 8)}, "cannot be read .actions.npy holds objects"),
        ({"actions": np.zeros((8, 1), np.int64)}, "actions of shape .8, 1."),
        ({"actions": np.asarray(1)}, "actions of shape .. and type int64"),
        ({"actions": np.zeros(7, np.int64)}, "observations of shape .8, 4. and type float32, and actions of shape .7,"),
        ({"rewards": np.zeros(7)}, "rewards of shape .7,. and type float64, expected .8,. of floating-point numbers"),
        ({"rewards": np.zeros(8, np.int64)}, "rewards of shape .8,. and type int64"),
        ({"actions": None}, "has no actions, expected observations, actions, epsilon, seed"),
        ({"observations": np.zeros((8, 5), np.float32)}, "observations of shape .8, 5."),
        ({"observations": np.zeros((8, 4))}, "type float64, and actions"),
        ({"observations": np.full((8, 4), np.nan, np.float32)}, r"observations holds nan at \[0, 0\], expected finite"),
        ({"observations": np.full((8, 4), np.inf, np.float32)}, r"observations holds inf at \[0, 0\], expected finite"),
        ({"epsilon": np.asarray(1.5)}, "has epsilon 1.5 and seed 7, expected a probability"),
        ({"epsilon": np.asarray(np.nan)}, "epsilon holds nan"),
        ({"epsilon": np.zeros(2)}, "has epsilon .0.0, 0.0. and seed 7"),
        ({"seed": np.asarray(-1)}, "and seed -1, expected a probability and a whole number"),
        ({"seed": np.asarray(1.5)}, "and seed 1.5"),
    ],
)
def test_a_recording_that_no_run_of_ours_wrote_is_refused(
    changes: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ExportError, match=message) as refused:
        recording.read_recording(saved(tmp_path / "a.npz", **changes), "a", SUITE)
    assert str(refused.value).isprintable()
    assert refused.value.exit_code == 2


def member(shape: tuple[int, ...], values: bytes) -> bytes:
    """An array whose header says another size than it has."""
    stream = io.BytesIO()
    np.lib.format.write_array_header_1_0(stream, {"descr": "<f4", "fortran_order": False, "shape": shape})
    return stream.getvalue() + values


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("encrypted", "it is encrypted"),
        ("method", "its compression has the number 14, expected stored or deflated"),
        ("huge", "observations.npy has 4 bytes or more, its header says 4,000,000,000,000"),
        ("longer", "observations.npy has 5 bytes or more, its header says 4"),
        ("negative", "an array of shape"),
        ("declared", "its arrays have 4,000,000,000 bytes, expected at most"),
        ("folder", "it is no file"),
        ("single", "it is a single array"),
        ("none", "No such file"),
        ("text", "File is not a zip file"),
    ],
)
def test_an_archive_that_numpy_does_not_write_is_one_line(
    name: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "a.npz"
    content = {
        "huge": member((10**12,), bytes(4)),
        "longer": member((1,), bytes(8)),
        "negative": member((-1,), bytes(4)),
    }.get(name, member((1,), bytes(4)))
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("observations.npy", content)
    raw = bytearray(path.read_bytes())
    central = raw.index(b"PK\x01\x02")
    if name == "encrypted":
        raw[central + 8] |= 1
    elif name == "method":
        raw[central + 10 : central + 12] = struct.pack("<H", 14)
    elif name == "declared":
        raw[central + 24 : central + 28] = struct.pack("<I", 4_000_000_000)
        monkeypatch.setattr("switchmt_snn.export.npz.available_bytes", lambda: 10**9)
    path.write_bytes(bytes(raw))
    if name in ("folder", "none"):
        path.unlink()
    if name == "folder":
        path.mkdir()
    elif name == "single":
        with path.open("wb") as stream:
            np.save(stream, np.zeros(3))
    elif name == "text":
        path.write_text("PK")
    with pytest.raises(ExportError, match=message) as refused:
        read_npz(path, ("observations",), "recorded play")
    assert str(refused.value).isprintable()


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_q_values_that_are_no_numbers_are_refused(value: float) -> None:
    valid = np.asarray([True, True, False])
    q_values = np.asarray([[0.0, 1.0, -np.inf], [2.0, 3.0, np.nan]], np.float32)
    require_numbers(q_values, len(q_values), valid, "ONNX", "breakout")
    q_values[1, 0] = value
    with pytest.raises(ExportError, match=f"the ONNX file gives the Q-value {value} in breakout, expected finite"):
        require_numbers(q_values, len(q_values), valid, "ONNX", "breakout")
