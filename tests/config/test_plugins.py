"""Classes from outside the package: a module that cannot be used is refused in one line."""

from __future__ import annotations

from pathlib import Path

import pytest

from switchmt_snn.cli import main
from switchmt_snn.config.plugins import load_plugin, plugin_name
from switchmt_snn.errors import ConfigError


@pytest.mark.slow
@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import no_such_package", "No module named 'no_such_package'"),
        ("class Broken(:", "SyntaxError"),
        ("missing_name", "NameError: name 'missing_name' is not defined"),
        ("raise ValueError('two\\nlines')", "ValueError: two lines"),
        ("other = 1", "it has no 'Mine'"),
    ],
)
@pytest.mark.parametrize("flag", ["--network.neuron", "--network.encoding", "--switching.policy", "--tasks.suite"])
def test_a_module_that_fails_is_one_line_and_exit_code_2(
    code: str,
    words: str,
    flag: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    name = f"module_{abs(hash((code, flag)))}"
    (tmp_path / f"{name}.py").write_text(code)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["train", flag, f"{name}:Mine", "--tasks.names", "pong"])
    error = capsys.readouterr().err
    assert (stop.value.code, error.count("\n")) == (2, 1)
    assert words in error
    assert f"{flag.removeprefix('--')} is '{name}:Mine'" in error


@pytest.mark.slow
def test_a_gymnasium_id_of_a_module_that_fails_is_one_line(tmp_path: Path, monkeypatch, capsys) -> None:
    (tmp_path / "failing_environments.py").write_text("missing_name")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        main(["train", "--tasks.suite", "gym", "--tasks.names", "failing_environments:Mine-v0"])
    error = capsys.readouterr().err
    assert (stop.value.code, error.count("\n")) == (2, 1)
    assert "NameError" in error


def test_a_class_of_an_importable_module_is_found() -> None:
    assert load_plugin("pathlib:Path", "key") is Path
    with pytest.raises(ConfigError, match="key is 'pathlib:Pth'"):
        load_plugin("pathlib:Pth", "key")


def test_a_name_in_place_of_a_class_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"policy is 'stale', expected a class"):
        plugin_name("stale", "policy")  # type: ignore[arg-type]
