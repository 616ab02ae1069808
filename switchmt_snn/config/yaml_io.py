"""Strict YAML <-> config: an unknown key, a wrong type or a value out of range stops with one line.

Also the documentation of every field, read from the source text of :mod:`switchmt_snn.config`.
"""

from __future__ import annotations

import ast
import contextlib
import dataclasses
import importlib.resources
import inspect
import math
import types
import typing
from pathlib import Path
from typing import Any, Literal, Union, get_args, get_origin

import yaml

from switchmt_snn.config import experiment as config_module
from switchmt_snn.config.experiment import ExperimentConfig
from switchmt_snn.config.plugins import is_plugin
from switchmt_snn.errors import ConfigError, did_you_mean


def load_config(source: str | Path) -> ExperimentConfig:
    """Read a config from a YAML file, or a preset by name (``quickstart``, ``paper``, ``configs/paper.yaml``).

    Raises:
        ConfigError: no such file or preset, not YAML, or a key or value that the config does not take.
    """
    path = Path(source)
    text = path.read_text(encoding="utf-8") if path.is_file() else _preset_text(path, str(source))
    try:
        data = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"{source} is not YAML ({' '.join(str(error).split())}); see docs/configuration.md"
        ) from error
    if data is None:
        data = {}
    return from_dict(data, where=str(source))


def _preset_text(path: Path, shown: str) -> str:
    presets = {
        entry.name.removesuffix(".yaml"): entry
        for entry in importlib.resources.files("switchmt_snn.configs").iterdir()
        if entry.name.endswith(".yaml")
    }
    is_name = path.suffix in ("", ".yaml") and (len(path.parts) == 1 or path.parts[:-1] == ("configs",))
    if is_name and path.stem in presets:
        return presets[path.stem].read_text(encoding="utf-8")
    raise ConfigError(f"no config file or preset {shown!r}{did_you_mean(path.stem, presets)}")


def from_dict(data: object, where: str = "config") -> ExperimentConfig:
    """Build a config from nested dicts, as YAML gives them; absent keys take the field's default.

    Raises:
        ConfigError: naming the key, the value seen, and what was expected.
    """
    return typing.cast(ExperimentConfig, _build(ExperimentConfig, data, where, ""))


def to_dict(config: ExperimentConfig) -> dict[str, Any]:
    """The config as nested dicts of plain values (tuples become lists), in field order."""

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: plain(item) for key, item in value.items()}
        return list(value) if isinstance(value, tuple) else value

    return typing.cast("dict[str, Any]", plain(dataclasses.asdict(config)))


def to_yaml(config: ExperimentConfig) -> str:
    """The config as YAML that :func:`load_config` reads back unchanged."""
    return yaml.safe_dump(to_dict(config), sort_keys=False, allow_unicode=True)


def differences(old: ExperimentConfig, new: ExperimentConfig) -> dict[str, tuple[Any, Any]]:
    """Fields that differ, as ``{"learning.batch_size": (old, new)}``."""
    flat_old, flat_new = _flatten(to_dict(old)), _flatten(to_dict(new))
    return {key: (flat_old[key], flat_new[key]) for key in flat_old if flat_old[key] != flat_new[key]}


def _flatten(data: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in data.items():
        flat.update(_flatten(value, f"{prefix}{key}.") if isinstance(value, dict) else {prefix + key: value})
    return flat


def _build(cls: type[Any], data: object, where: str, prefix: str) -> Any:
    if not isinstance(data, dict):
        raise ConfigError(f"{where}: {prefix.rstrip('.') or 'the file'} is {data!r}, expected a mapping of settings")
    hints = typing.get_type_hints(cls)
    values: dict[str, Any] = {}
    for key, value in data.items():
        if key not in hints:
            raise ConfigError(f"{where}: unknown key {prefix}{key}{did_you_mean(str(key), hints)}")
        values[key] = _convert(hints[key], value, where, f"{prefix}{key}")
    try:
        return cls(**values)
    except ConfigError as error:
        raise error if str(error).startswith(where) else ConfigError(f"{where}: {error}") from None


def _convert(hint: Any, value: Any, where: str, key: str) -> Any:
    if dataclasses.is_dataclass(hint):
        return _build(typing.cast("type[Any]", hint), value, where, f"{key}.")
    origin = get_origin(hint)
    if origin in (Union, types.UnionType):
        arms = get_args(hint)
        if value is None and type(None) in arms:
            return None
        arms = tuple(arm for arm in arms if arm is not type(None))
        if str in arms and is_plugin(value):  # Literal[...] | PluginName
            return value
        arms = tuple(arm for arm in arms if arm is not str) if len(arms) > 1 else arms
        if all(get_origin(arm) is Literal for arm in arms):
            return _choice(tuple(c for arm in arms for c in get_args(arm)), value, where, key)
        return _convert(arms[0], value, where, key)
    if origin is Literal:
        return _choice(get_args(hint), value, where, key)
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"{where}: {key} is {value!r}, expected a list")
        return tuple(_convert(get_args(hint)[0], item, where, key) for item in value)
    return _scalar(hint, value, where, key)


def _choice(choices: tuple[Any, ...], value: Any, where: str, key: str) -> Any:
    if value not in choices:
        names = [str(choice) for choice in choices]
        hint = did_you_mean(str(value), names)
        raise ConfigError(f"{where}: {key} is {value!r}, expected one of {', '.join(names)}{hint}")
    return value


def _scalar(kind: type[Any], value: Any, where: str, key: str) -> Any:
    is_number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if kind is float and isinstance(value, str):
        # YAML 1.1 reads 1e-4 (no dot) as text; a researcher means a number.
        with contextlib.suppress(ValueError):
            value = float(value)
            is_number = True
    if kind is float and is_number and math.isfinite(value):
        return float(value)
    if kind is int and is_number and math.isfinite(value) and float(value).is_integer():
        return int(value)
    if kind in (bool, str) and isinstance(value, kind):
        return value
    names = {int: "a whole number", float: "a finite number", bool: "true or false", str: "text"}
    raise ConfigError(f"{where}: {key} is {value!r}, expected {names[kind]}")


def field_documentation() -> list[tuple[str, str, list[tuple[str, str, str, str]]]]:
    """Sections of the config as ``(prefix, section text, [(key, type, default, text)])``, in order.

    Read from the source of :mod:`switchmt_snn.config`: the string under a field is its documentation.
    """
    tree = ast.parse(inspect.getsource(config_module))
    classes = {node.name: node for node in tree.body if isinstance(node, ast.ClassDef)}
    sections = []
    for prefix, cls in _sections():
        node = classes[cls.__name__]
        texts: dict[str, tuple[str, str]] = {}
        for statement, after in zip(node.body, [*node.body[1:], None], strict=True):
            if isinstance(statement, ast.AnnAssign) and isinstance(statement.target, ast.Name):
                text = ""
                if isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant):
                    text = " ".join(str(after.value.value).split())
                texts[statement.target.id] = (ast.unparse(statement.annotation), text)
        rows = []
        for item in dataclasses.fields(cls):
            if not dataclasses.is_dataclass(typing.get_type_hints(cls)[item.name]):
                annotation, text = texts[item.name]
                rows.append((prefix + item.name, annotation, _shown(item.default), text))
        sections.append((prefix.rstrip("."), inspect.getdoc(cls) or "", rows))
    return sections


def _shown(value: Any) -> str:
    return yaml.safe_dump(list(value) if isinstance(value, tuple) else value, default_flow_style=True).split("\n")[0]


def _sections() -> list[tuple[str, type[Any]]]:
    hints = typing.get_type_hints(ExperimentConfig)
    nested = [(f"{name}.", kind) for name, kind in hints.items() if dataclasses.is_dataclass(kind)]
    return [("", ExperimentConfig), *typing.cast("list[tuple[str, type[Any]]]", nested)]
