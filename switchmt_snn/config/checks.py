"""Checks of config values, the same for a config made in Python, in YAML, or by flags.

Every config calls ``check_fields`` as it is made, and then ``require`` for ranges.
"""

from __future__ import annotations

import contextlib
import dataclasses
import math
import types
import typing
from typing import Any, Literal, Union, cast, get_args, get_origin

from switchmt_snn.config.bounds import LONGEST_LIST, LONGEST_TEXT, largest
from switchmt_snn.config.numbers import whole_number
from switchmt_snn.config.plugins import PluginName, is_plugin
from switchmt_snn.errors import ConfigError, nearest

_KINDS = {int: "a whole number", float: "a finite number", bool: "true or false", str: "text"}


def require(holds: bool, key: str, seen: object, expected: str, remedy: str = "") -> None:
    """Refuse a value.

    Raises:
        ConfigError: the condition does not hold; names the key, the value seen, and what was expected.
    """
    if not holds:
        raise ConfigError(f"{key} is {seen!r:.120}, expected {expected}{'; ' + remedy if remedy else ''}")


def check_fields(config: Any, section: str = "") -> None:
    """Check every field of a config against its annotation, and store the values in their annotated types.

    A whole float becomes an int (``64.0``), an int or a number as text (YAML reads ``1e-4`` as text) a float, a list a
    tuple. A bool is no number. Sizes have the bounds of ``switchmt_snn.config.bounds``.

    Args:
        config: a frozen dataclass, as it is made.
        section: its name in the experiment's config; empty for the experiment itself.

    Raises:
        ConfigError: an unknown choice, a value of another type or size; names the key.
    """
    for name, annotation in field_types(type(config)).items():
        key = f"{section}.{name}" if section else name
        object.__setattr__(config, name, _checked(annotation, getattr(config, name), key))


def field_types(config: type[Any]) -> dict[str, Any]:
    """Names and evaluated annotations of the fields of a config class, in order."""
    hints = typing.get_type_hints(config)
    return {field.name: hints[field.name] for field in dataclasses.fields(config)}


def choices(annotation: Any) -> tuple[str, ...]:
    """The names that a field accepts, as in ``Literal["auto"] | Policy | PluginName``; empty if it is no choice."""
    arms = _arms(annotation)
    return tuple(name for arm in arms if get_origin(arm) is Literal for name in get_args(arm))


def accepts_plugins(annotation: Any) -> bool:
    """Whether a field also accepts a class from outside the package, as ``package.module:Name``."""
    return PluginName in _arms(annotation)


def _arms(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)


def kind_of(annotation: Any) -> tuple[Any, bool]:
    """The type of a field that is no choice, and whether it may be None: ``int | None`` gives ``(int, True)``."""
    arms = _arms(annotation)
    (kind,) = (arm for arm in arms if arm is not type(None))
    return kind, type(None) in arms


def _checked(annotation: Any, value: Any, key: str) -> Any:
    names = choices(annotation)
    if names:
        return _choice(names, accepts_plugins(annotation), value, key)
    kind, optional = kind_of(annotation)
    if value is None and optional:
        return None
    if dataclasses.is_dataclass(kind):
        require(isinstance(value, cast("type[Any]", kind)), key, value, f"a {kind.__name__}")  # type: ignore[union-attr]
        return value
    if get_origin(kind) is tuple:
        require(isinstance(value, (list, tuple)), key, value, "a list")
        require(len(value) <= LONGEST_LIST, key, value, f"at most {LONGEST_LIST} entries")
        return tuple(_scalar(get_args(kind)[0], item, key) for item in value)
    return _scalar(kind, value, key)


def _choice(names: tuple[str, ...], plugins: bool, value: Any, key: str) -> str:
    if isinstance(value, str) and (value in names or (plugins and is_plugin(value))):
        return str(value)
    expected = f"one of {', '.join(names)}{', or a class as package.module:Name' if plugins else ''}"
    raise ConfigError(f"{key} is {value!r:.120}, expected {expected}{nearest(str(value)[:LONGEST_TEXT], names)}")


def _scalar(kind: type[Any], value: Any, key: str) -> Any:
    number = value
    if isinstance(value, str) and kind in (int, float) and len(value) <= LONGEST_TEXT:
        # YAML 1.1 reads 1e-4 (no dot) as text; a researcher means a number.
        with contextlib.suppress(ValueError):
            number = float(value) if kind is float else whole_number(value)
    if isinstance(number, (int, float)) and not isinstance(number, bool) and kind in (int, float):
        return _number(kind, number, value, key)
    if kind in (bool, str) and isinstance(value, kind):
        require(kind is bool or len(value) <= LONGEST_TEXT, key, value, f"at most {LONGEST_TEXT} characters")
        return kind(value)
    raise _of_another_kind(kind, value, key)


def _number(kind: type[Any], number: int | float, value: Any, key: str) -> int | float:
    """A number in its annotated type, within its bounds; ``value`` is as it was written."""
    bound = largest(key, kind)
    finite = isinstance(number, int) or math.isfinite(number)  # a whole number may be larger than any float
    if not finite or (kind is int and number != int(number)):
        raise _of_another_kind(kind, value, key)
    require(-bound <= number <= bound, key, value, f"at most {bound:,}" if kind is int else f"at most {bound:g}")
    return int(number) if kind is int else float(number)


def _of_another_kind(kind: type[Any], value: Any, key: str) -> ConfigError:
    return ConfigError(f"{key} is {value!r:.120}, expected {_KINDS[kind]}")
