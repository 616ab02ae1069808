"""The house: floors, packaging, sizes, and what may never come back."""

from __future__ import annotations

import ast
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOORS = {
    "errors": 0,
    "config": 1,
    "config_io": 2,
    "spiking": 3,
    "tasks": 3,
    "learning": 4,
    "export": 5,
    "viewing": 5,
    "cli": 6,
    "__main__": 7,
    "__init__": 7,
}


def sources() -> list[Path]:
    return [*sorted((ROOT / "switchmt_snn").rglob("*.py")), *sorted((ROOT / "export").rglob("*.py"))]


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
    assert text.count("\n") <= 450, path
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


def test_wheel_carries_everything_and_no_top_level_export(tmp_path: Path) -> None:
    subprocess.run(
        [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", str(tmp_path), str(ROOT)],
        check=True,
        capture_output=True,
    )
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    assert "switchmt_snn/export/__init__.py" in names
    assert "switchmt_snn/configs/quickstart.yaml" in names
    assert "switchmt_snn/py.typed" in names
    tops = {name.split("/")[0] for name in names}
    assert tops == {"switchmt_snn", next(top for top in tops if top.endswith(".dist-info"))}
    target = tmp_path / "site"
    with zipfile.ZipFile(wheel) as archive:
        archive.extractall(target)
    code = (
        "import switchmt_snn.export, switchmt_snn.config_io as c, sys; c.load_config('paper');"
        "assert switchmt_snn.export.__file__.startswith(sys.argv[1]), switchmt_snn.export.__file__"
    )
    subprocess.run([sys.executable, "-c", code, str(target)], check=True, cwd=target)


def test_this_install_finds_export_and_configs() -> None:
    import switchmt_snn.export
    from switchmt_snn.config_io import load_config

    assert switchmt_snn.export.__doc__
    assert load_config("quickstart").name == "quickstart"
