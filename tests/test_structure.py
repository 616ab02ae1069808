"""Structure: imports, sizes. Ruff checks docstrings and forbidden calls (pyproject.toml)."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from importlinter.cli import lint_imports

ROOT = Path(__file__).parent.parent


def sources() -> list[Path]:
    inside = [path for path in (ROOT / "switchmt_snn").rglob("*.py") if not path.is_symlink()]
    return [*sorted(inside), *sorted((ROOT / "export").rglob("*.py"))]


def test_imports_keep_the_contracts_of_pyproject(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """``lint-imports``: packages import downward only."""
    monkeypatch.syspath_prepend(ROOT)
    failed = lint_imports(config_filename=str(ROOT / "pyproject.toml"), no_cache=True)
    assert not failed, capsys.readouterr().out


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_stay_readable(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") <= 450, path
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            assert (node.end_lineno or 0) - node.lineno <= 70, node.name


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_docstrings_have_no_sphinx_roles(path: Path) -> None:
    """The site renders Markdown: write ``name``."""
    roles = (":" + role + ":`" for role in ("func", "class", "meth", "mod", "data", "attr", "exc"))
    assert not any(role in path.read_text() for role in roles), f"{path}: write ``name``, no Sphinx role"
