"""When a run takes the native engine, and what it says if it cannot."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from switchmt_snn.errors import ConfigError
from switchmt_snn.native import library as native_library
from switchmt_snn.native import supports
from switchmt_snn.updates.native import Native
from tests.conftest import decided, small_config

CPU = torch.device("cpu")


def settled(trunk: str, precision: str, engine: str = "auto", method: str = "SwitchMT") -> tuple[str, list[str]]:
    asked = small_config(
        network={"trunk": trunk, "method": method}, learning={"precision": precision, "engine": engine}
    )
    config, notes = decided(asked)
    return config.learning.engine, list(notes)


@pytest.mark.parametrize(
    ("trunk", "precision", "has_bits", "expected"),
    [
        ("nature", "bfloat16", True, "native"),
        ("nature", "bfloat16", False, "native"),
        ("nature", "float32", True, "native"),
        ("nature", "float32", False, "eager"),
        ("minatar", "bfloat16", True, "eager"),
    ],
)
def test_auto_is_native_on_the_nature_trunk_if_that_is_the_fastest(
    trunk: str, precision: str, has_bits: bool, expected: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supports, "problem", lambda: None)
    monkeypatch.setattr(supports, "spikes_as_bits", lambda dtype: has_bits)
    engine, notes = settled(trunk, precision)
    assert engine == expected
    assert notes == ([Native.note] if expected == "native" else [])
    assert settled(trunk, precision, "eager") == ("eager", [])


@pytest.mark.parametrize("has_bits", [True, False])
@pytest.mark.parametrize(("total_steps", "expected"), [(4_999, "eager"), (5_000, "native")])
def test_auto_builds_the_native_engine_for_vectors_if_a_run_makes_enough_updates(
    total_steps: int, expected: str, has_bits: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(supports, "problem", lambda: None)
    monkeypatch.setattr(supports, "spikes_as_bits", lambda dtype: has_bits)
    assert decided(small_config(total_steps=total_steps))[0].learning.engine == expected


def test_auto_says_why_it_does_not_take_the_native_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(supports, "problem", lambda: "no luck")
    engine, (note,) = settled("nature", "bfloat16")
    assert engine == "eager"
    assert note == "updates do not use the native engine: it cannot be built here (no luck)"


def test_auto_says_nothing_of_the_native_engine_to_an_ann() -> None:
    assert settled("nature", "float32", method="DQN_D") == ("eager", [])


def test_a_failing_compiler_is_named_with_what_to_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("CXX", "no-such-compiler")
    asked, eager = small_config(learning={"engine": "native"}), small_config(learning={"engine": "eager"})
    native_library.library.cache_clear()
    try:
        with pytest.raises(ConfigError, match=r"a C\+\+ compiler .*no-such-compiler'\); use learning.engine=eager"):
            decided(asked)
        with pytest.raises(ConfigError, match=r"this run was begun, .*compiler'\); start another run \(--run OTHER"):
            decided(small_config(), asked)
        with pytest.raises(ConfigError, match=r"is 'native', expected .*compiler'\); use learning.engine=eager"):
            decided(asked, eager)  # not the engine it was begun with
    finally:
        native_library.library.cache_clear()
