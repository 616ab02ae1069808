"""The house: floors, packaging, sizes, and what may never come back."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOORS = {
    "errors": 0,
    "config": 1,
    "machine": 2,
    "spiking": 2,
    "tasks": 2,
    "replay": 3,
    "native": 3,
    "updates": 4,
    "learning": 5,
    "acting": 5,
    "runs": 6,
    "export": 7,
    "viewing": 7,
    "cli": 8,
    "__main__": 9,
    "__init__": 9,
}


def sources() -> list[Path]:
    inside = [path for path in (ROOT / "switchmt_snn").rglob("*.py") if not path.is_symlink()]
    return [*sorted(inside), *sorted((ROOT / "export").rglob("*.py"))]


def room(path: Path) -> str:
    parts = path.relative_to(ROOT).parts
    return "export" if parts[0] == "export" else parts[1].removesuffix(".py")


def imported_rooms(path: Path) -> set[str]:
    rooms = set()
    for node in ast.walk(ast.parse(path.read_text())):
        names = []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module] if node.module != "switchmt_snn" else [f"switchmt_snn.{a.name}" for a in node.names]
        elif isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        for name in names:
            assert name.split(".")[0] != "export", f"{path}: imports the export folder under its bare name"
            if name.startswith("switchmt_snn."):
                rooms.add(name.split(".")[1])
    return rooms - {"__version__"}


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_only_go_down(path: Path) -> None:
    here = room(path)
    for other in imported_rooms(path):
        if other != here:
            assert FLOORS[other] < FLOORS[here], f"{here} imports {other}"


def test_spiking_and_tasks_do_not_know_each_other() -> None:
    for path in sources():
        if room(path) == "spiking":
            assert "tasks" not in imported_rooms(path), path
        if room(path) == "tasks":
            assert "spiking" not in imported_rooms(path), path


@pytest.mark.parametrize("path", sources(), ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_functions_stay_readable(path: Path) -> None:
    text = path.read_text()
    assert text.count("\n") <= 470, path
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.FunctionDef):
            assert (node.end_lineno or 0) - node.lineno <= 70, node.name
        if isinstance(node, ast.Call):
            assert ast.unparse(node.func) not in ("eval", "exec", "torch.load", "yaml.load"), ast.unparse(node)
        if isinstance(node, ast.Import):
            assert "pickle" not in [alias.name for alias in node.names]


def public(body: list[ast.stmt]) -> list[ast.FunctionDef | ast.ClassDef]:
    """Public functions and classes of a module or class body, and the public methods of those classes."""
    found: list[ast.FunctionDef | ast.ClassDef] = []
    for node in body:
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and not node.name.startswith("_"):
            found.append(node)
            if isinstance(node, ast.ClassDef):
                found += public(node.body)
    return found


def test_public_functions_have_docstrings() -> None:
    for path in sources():
        for node in public(ast.parse(path.read_text()).body):
            assert ast.get_docstring(node), f"{path.name}: {node.name}"
