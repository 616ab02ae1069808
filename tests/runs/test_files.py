"""Names of files that hold tasks."""

from __future__ import annotations

import errno
import json
import math
import os
import re
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from switchmt_snn.errors import WriteError
from switchmt_snn.runs.files import file_name, json_text, parsed_json, write_atomically, writing, written_whole
from switchmt_snn.tasks.registry import SUITES

TASKS = st.one_of(
    st.text(st.sampled_from("aB1_.-~+/: "), min_size=1, max_size=6),
    st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=300),
    st.sampled_from(["parity", "evaluation_onnx", "ALE/Pong-v5", "ALE_Pong-v5", "m:E-v0", "..", "-h"]),
)
LISTS = st.lists(TASKS, min_size=1, max_size=12, unique=True).map(tuple)


@pytest.mark.slow
@given(LISTS, LISTS)
def test_other_tasks_have_another_file_name(one: tuple[str, ...], two: tuple[str, ...]) -> None:
    assert (file_name(*one) == file_name(*two)) == (one == two)


@pytest.mark.slow
@given(LISTS)
def test_file_names_are_safe_and_short(tasks: tuple[str, ...]) -> None:
    name = file_name(*tasks)
    assert re.fullmatch(r"[A-Za-z0-9_~][A-Za-z0-9_.+~-]*", name)
    assert len(name) <= 120
    assert name not in ("parity", "evaluation_onnx", "evaluation_nir")


def test_names_of_known_tasks_stay_as_they_are() -> None:
    for suite in SUITES.values():
        assert all(file_name(task) == task for task in suite.known_tasks() if not set(task) & set("/:"))
    assert file_name("breakout", "pong") == "breakout+pong"


def test_two_writers_of_one_file_do_not_meet(tmp_path: Path) -> None:
    """Both write whole files; the one that ends last stays."""
    path = tmp_path / "file.json"
    with written_whole(path) as outer, written_whole(path) as inner:
        assert outer != inner
        outer.write_text("outer")
        inner.write_text("inner")
    assert path.read_text() == "outer"
    with pytest.raises(UnicodeEncodeError), written_whole(path) as failed:
        failed.write_text("half \N{SNOWMAN}", "ascii")
    assert path.read_text() == "outer"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize(
    ("number", "code", "remedy"),
    [
        (errno.ENOSPC, 1, "expected a disk that works and has room; then run the same command again"),
        (errno.EIO, 1, "expected a disk that works and has room; then run the same command again"),
        (errno.EACCES, 2, "expected a writable folder; name another with --out"),
    ],
)
def test_what_the_system_refuses_names_the_file(number: int, code: int, remedy: str, tmp_path: Path) -> None:
    path = tmp_path / "a.json"

    def fail() -> None:
        with written_whole(path, "--out") as temporary:
            temporary.write_text("half")
            raise OSError(number, os.strerror(number), str(temporary))

    with pytest.raises(WriteError) as refused:
        fail()
    assert str(refused.value) == f"{path} cannot be written ({os.strerror(number)}), {remedy}"
    assert refused.value.exit_code == code
    assert list(tmp_path.iterdir()) == []


def test_a_folder_that_is_written_whole_is_named_for_its_files_cannot_be_written(tmp_path: Path) -> None:
    whole = tmp_path / "checkpoint"
    with pytest.raises(WriteError, match=f"^{whole} cannot be written"), writing(whole, whole=True):
        write_atomically(tmp_path / "none" / "a.json", b"")
    with pytest.raises(WriteError, match=r"a\.json cannot be written"), writing(whole):
        write_atomically(tmp_path / "none" / "a.json", b"")


def test_json_holds_no_number_that_json_does_not_know() -> None:
    values = {"a": [1.5, math.nan, (math.inf, -math.inf)], "b": {"c": None, "d": "NaN"}}
    text = json_text(values, indent=1)
    assert json.loads(text, parse_constant=lambda name: 1 / 0) == {
        "a": [1.5, None, [None, None]],
        "b": {"c": None, "d": "NaN"},
    }


@pytest.mark.parametrize("frames", [0, 700])
@pytest.mark.parametrize("levels", [101, 400, 100_000])
def test_json_that_is_too_deep_is_refused_wherever_it_is_read(levels: int, frames: int) -> None:
    def read(frames: int) -> Any:
        return read(frames - 1) if frames else parsed_json("[" * levels + "]" * levels)

    with pytest.raises(ValueError, match="more than 100 levels"):
        read(frames)


def test_json_of_a_hundred_levels_is_read() -> None:
    value = parsed_json('{"a": [' * 50 + "]}" * 50)
    for _ in range(49):
        value = value["a"][0]
    assert value == {"a": []}
