"""Building, keeping and loading the C++ sources."""

from __future__ import annotations

import ctypes
import os
import re
from pathlib import Path

import pytest

from switchmt_snn.native import library as native_library

NATIVE = Path(native_library.__file__).parent


@pytest.mark.slow
@pytest.mark.skipif(native_library.problem() is not None, reason="no C++ compiler")
def test_a_library_is_built_once_and_again_if_it_is_damaged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    build, folders = native_library._build, []

    def counted(compiler: list[str], folder: Path) -> Path:
        folders.append(folder)
        return build(compiler, folder)

    monkeypatch.setattr(native_library, "_build", counted)

    def load() -> Path:
        native_library.library.cache_clear()
        assert native_library.problem() is None
        kept, summed = sorted((tmp_path / "switchmt_snn").iterdir(), key=lambda path: path.suffix, reverse=True)
        assert (kept.suffix, summed.suffix) == (".so", ".sha256")
        return kept

    try:
        damaged = native_library._cache() / f"native-{native_library._key(native_library._compiler())}.so"
        damaged.parent.mkdir()
        damaged.write_bytes(b"not a library")
        assert load() == load() == damaged
        assert damaged.stat().st_size > 10_000
        assert len(folders) == 1
        monkeypatch.setenv("XDG_CACHE_HOME", "/proc/no-such-folder")
        native_library.library.cache_clear()
        assert native_library.problem() is None
        assert not any(folder.exists() for folder in folders)
        assert native_library._key(["g++"]) != native_library._key(["g++", "-g"])
    finally:
        native_library.library.cache_clear()


@pytest.mark.parametrize(
    "change", ["cut off", "zeros", "no sum", "other sum", "writable file", "writable folder", "link", "owner"]
)
def test_a_kept_library_is_loaded_only_if_it_is_whole_and_this_user_s(
    change: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "cache" / "native-1.so"
    previous = os.umask(0)
    try:
        native_library._keep(bytes(range(256)), kept)
    finally:
        os.umask(previous)
    assert native_library._is_ours(kept)
    assert sorted(path.name for path in kept.parent.iterdir()) == ["native-1.sha256", "native-1.so"]
    if change == "cut off":
        kept.write_bytes(kept.read_bytes()[:100])
    elif change == "zeros":
        kept.write_bytes(bytes(256))
    elif change == "no sum":
        kept.with_suffix(".sha256").unlink()
    elif change == "other sum":
        kept.with_suffix(".sha256").write_bytes(b"\xff")
    elif change == "writable file":
        kept.chmod(0o666)
    elif change == "writable folder":
        kept.parent.chmod(0o777)
    elif change == "link":
        kept.rename(tmp_path / "elsewhere.so")
        kept.symlink_to(tmp_path / "elsewhere.so")
    else:
        monkeypatch.setattr(os, "getuid", lambda: 12345)
    assert not native_library._is_ours(kept)


def test_a_missing_and_a_failing_compiler_give_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    native_library.library.cache_clear()
    try:
        monkeypatch.setenv("CXX", "no-such-compiler")
        assert native_library.problem() == "no C++ compiler 'no-such-compiler'"
        script = tmp_path / "failing"
        script.write_text("#!/bin/sh\n[ $1 = --version ] && exit 0\necho unhappy >&2\nexit 1\n")
        script.chmod(0o755)
        monkeypatch.setenv("CXX", str(script))
        assert native_library.problem() == "unhappy"
        assert not (tmp_path / "switchmt_snn").exists()
        for value in ('"g++', "no-such-compiler -g"):
            monkeypatch.setenv("CXX", value)
            assert str(native_library.problem()).startswith("no C++ compiler")
    finally:
        native_library.library.cache_clear()


def test_every_function_that_python_calls_is_found_in_the_sources() -> None:
    """ctypes takes the types of arguments from there, so a function that it misses would be called unchecked."""
    found = native_library.signatures()
    called = set(re.findall(r"library\(\)\.(snn_\w+)\(", "".join(path.read_text() for path in NATIVE.glob("*.py"))))
    assert called - {"snn_has_products", "snn_has_bfloat16"} == found.keys()
    expected = [ctypes.c_void_p, ctypes.c_long, ctypes.c_double, ctypes.c_double, ctypes.c_double, ctypes.c_double]
    assert found["snn_adam"] == [*expected, ctypes.c_int]


@pytest.mark.parametrize("name", ["Neuron", "Head", "Tensor"])
def test_structures_have_the_fields_of_the_sources(name: str) -> None:
    """In the same order and of the same kinds: pointer, float, int or long."""
    from switchmt_snn.native import adam, neurons, streams

    structure = {"Neuron": neurons._Neuron, "Head": streams._Head, "Tensor": adam._Tensor}[name]
    text = "".join(path.read_text() for path in (NATIVE / "csrc").glob("*.cpp"))
    (body,) = re.findall(rf"struct {name} \{{(.*?)\}};", text, re.DOTALL)
    fields = []
    for declaration in re.sub(r"//.*", "", body).split(";"):
        words = declaration.replace("*", " * ").replace(",", " ").split()
        kind = "p" if "*" in words else next((word[0] for word in words if word != "const"), "")
        names = [word for word in words if word not in ("const", "float", "int", "long", "void", "*")]
        fields += [(field, kind) for field in names]
    kinds = {ctypes.c_void_p: "p", ctypes.c_float: "f", ctypes.c_int: "i", ctypes.c_long: "l"}
    assert [(field, kinds[type_]) for field, type_ in structure._fields_] == fields
