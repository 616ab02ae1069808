"""The documentation of every setting, read from the text under its field."""

from __future__ import annotations

import ast
import dataclasses
import inspect
import textwrap
from typing import Any, cast, get_args, get_origin

import yaml

from switchmt_snn.config.checks import accepts_plugins, choices, field_types, kind_of
from switchmt_snn.config.experiment import ExperimentConfig


def field_documentation() -> list[tuple[str, str, list[tuple[str, str, str, str]]]]:
    """Sections of the config as ``(prefix, section text, [(key, type, default, text)])``, in order.

    Read from the source of the config classes: the string under a field is its documentation.
    """
    sections = []
    for prefix, cls in _sections():
        (node,) = ast.parse(textwrap.dedent(inspect.getsource(cls))).body
        assert isinstance(node, ast.ClassDef)
        texts: dict[str, str] = {}
        for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
                text = ""
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    text = " ".join(str(after.value.value).split())
                texts[statement.target.id] = text
        rows = []
        for item in dataclasses.fields(cls):
            kind = field_types(cls)[item.name]
            if not dataclasses.is_dataclass(kind):
                rows.append((prefix + item.name, type_text(kind), _shown(item.default), texts[item.name]))
        sections.append((prefix.rstrip("."), inspect.getdoc(cls) or "", rows))
    return sections


def type_text(annotation: Any) -> str:
    """The values that a field accepts, in words: ``int or null``, ``IF, LIF or package.module:Name``."""
    names = choices(annotation)
    if names:
        return ", ".join(names) + (" or package.module:Name" if accepts_plugins(annotation) else "")
    kind, optional = kind_of(annotation)
    name = f"list of {get_args(kind)[0].__name__}" if get_origin(kind) is tuple else kind.__name__
    return f"{name} or null" if optional else name


def _shown(value: Any) -> str:
    return yaml.safe_dump(list(value) if isinstance(value, tuple) else value, default_flow_style=True).split("\n")[0]


def _sections() -> list[tuple[str, type[Any]]]:
    fields = field_types(ExperimentConfig).items()
    nested = [(f"{name}.", cast("type[Any]", kind)) for name, kind in fields if dataclasses.is_dataclass(kind)]
    return [("", ExperimentConfig), *nested]
