"""Structure: imports, sizes. Ruff checks docstrings and forbidden calls (pyproject.toml)."""

from __future__ import annotations

import ast
import importlib
import pkgutil
import re
from pathlib import Path
from types import ModuleType

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


@pytest.mark.slow
def test_a_method_that_a_subclass_must_define_says_so() -> None:
    """``raise NotImplementedError`` alone would be a traceback without a word."""
    raised = 0
    for path in sources():
        for node in ast.walk(ast.parse(path.read_text())):
            if not isinstance(node, ast.Raise):
                continue
            if isinstance(node.exc, ast.Call) and getattr(node.exc.func, "id", "") == "NotImplementedError":
                raised += 1
                assert ", expected " in ast.unparse(node.exc), f"{path}:{node.lineno}"
            assert getattr(node.exc, "id", "") != "NotImplementedError", f"{path}:{node.lineno}"
    assert raised >= 5


def packages() -> list[str]:
    found = [path.parent.relative_to(ROOT) for path in sources() if path.name == "__init__.py"]
    return [
        ".".join(path.parts if path.parts[0] == "switchmt_snn" else ("switchmt_snn", *path.parts)) for path in found
    ]


@pytest.mark.parametrize("package", packages())
def test_no_name_of_a_package_hides_one_of_its_modules(package: str) -> None:
    """``import a.b.c`` must give the module c, not a function of that name."""
    namespace = importlib.import_module(package)
    for module in pkgutil.iter_modules(namespace.__path__):
        found = vars(namespace).get(module.name)
        assert found is None or isinstance(found, ModuleType), f"{package}.{module.name} is a module and {found!r}"


def test_files_that_messages_and_recipes_send_a_reader_to_define_the_name() -> None:
    """As in "add it to Policy in switchmt_snn/config/switching.py"."""
    texts = [*(path.read_text() for path in sources()), (ROOT / "docs" / "extending.md").read_text()]
    pattern = re.compile(r"`?([A-Z]\w+)`? \(?(?:in )?`?(switchmt_snn/[\w/]+\.py)")
    named = [match for text in texts for match in pattern.findall(text)]
    assert {"Policy", "EncodingName", "ENCODINGS", "ENGINES", "Engine"} & {name for name, _ in named}
    for name, file in named:
        assert re.search(rf"^(class )?{name}\b", (ROOT / file).read_text(), re.MULTILINE), f"{name} in {file}"
