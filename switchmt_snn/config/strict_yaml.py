"""The one reader of YAML: configs, targets, chips and options go through it, also those of strangers.

It takes UTF-8 text of at most ``MOST_BYTES``, one document of mappings, lists and plain values. Anchors, aliases and
tags are refused, and so are a key that is written twice, deep nesting, and whole numbers of more than 19 digits. Dates,
numbers in base 60 or with a prefix (``0x10``) are text; so is ``1e-4`` (YAML 1.1), which settings read as a number.
"""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import yaml

from switchmt_snn.errors import ConfigError, printable, reason_of

MOST_BYTES = 65_536
"""Most bytes of a file (the longest of ours have 4,000; PyYAML reads some 100,000 bytes per second)."""
MOST_LEVELS = 12
"""Most mappings and lists within each other."""
LONGEST_KEY = 100
"""Characters of a key."""
MOST_DIGITS = 19
"""Most digits of a whole number: 64 bits."""
_NULL = re.compile(r"~|null|Null|NULL|")
_TRUTH = re.compile(r"yes|Yes|YES|no|No|NO|true|True|TRUE|false|False|FALSE|on|On|ON|off|Off|OFF")
_WHOLE = re.compile(r"[-+]?(0|[1-9][0-9_]*)")
_FLOAT = re.compile(r"[-+]?([0-9][0-9_]*\.[0-9_]*|\.[0-9][0-9_]*)([eE][-+][0-9]+)?")
_SPECIAL = {".inf": math.inf, "+.inf": math.inf, "-.inf": -math.inf, ".nan": math.nan}


def read_text(path: str | Path, what: str) -> str:
    """Text of a file.

    Args:
        path: the file.
        what: what it should be, for the error: ``a config``.

    Raises:
        ConfigError: it cannot be read, is larger than ``MOST_BYTES``, or is not UTF-8.
    """
    shown = printable(path)
    try:
        if not Path(path).is_file():
            raise ConfigError(f"{shown} cannot be read (it is no file), expected {what} as YAML; check the path")
        with Path(path).open("rb") as stream:
            content = stream.read(MOST_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL
        reason = error.strerror if isinstance(error, OSError) else error
        raise ConfigError(f"{shown} cannot be read ({reason}), expected {what} as YAML") from error
    if len(content) > MOST_BYTES:
        raise ConfigError(f"{shown} has more than {MOST_BYTES:,} bytes, expected {what} as YAML; shorten it")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise ConfigError(f"{shown} is not UTF-8 text, expected {what} as YAML; save it as UTF-8") from error


def parse_yaml(text: str, where: str, what: str) -> Any:
    """The value of a YAML text: dicts, lists, texts, numbers, truth values and None.

    Args:
        text: one document; an empty one gives None.
        where: name of the file, for errors.
        what: what it should be, for errors: ``a config``.

    Raises:
        ConfigError: it is not the YAML that this module's docstring describes.
    """
    try:
        return _Reader(text).document()
    except yaml.YAMLError as error:
        reason = reason_of(error)
        raise ConfigError(f"{printable(where)} is not YAML that is taken here ({reason}), expected {what}") from error


def plain_value(text: str) -> Any:
    """What a plain word of YAML stands for: None, a truth value, a number, or the text itself.

    Raises:
        yaml.YAMLError: a whole number of more than ``MOST_DIGITS`` digits.
    """
    if _NULL.fullmatch(text):
        return None
    if _TRUTH.fullmatch(text):
        return text.lower() in ("yes", "true", "on")
    digits = text.replace("_", "")
    if _WHOLE.fullmatch(text):
        if len(digits.lstrip("+-")) > MOST_DIGITS:
            raise yaml.YAMLError(f"a whole number of {len(digits)} digits, expected at most {MOST_DIGITS}")
        return int(digits)
    if _FLOAT.fullmatch(text):
        return float(digits)
    return _SPECIAL.get(text.lower(), text)


class _Reader:
    """From PyYAML's events to plain values; its constructors, which follow tags, are not used."""

    def __init__(self, text: str) -> None:
        self._loader: Any = yaml.SafeLoader(text)  # its methods have no types
        self._levels = 0

    def document(self) -> Any:
        self._loader.get_event()  # the stream begins
        if self._loader.check_event(yaml.StreamEndEvent):
            return None
        self._loader.get_event()  # the document begins
        value = self._value()
        self._loader.get_event()  # it ends
        if not self._loader.check_event(yaml.StreamEndEvent):
            raise yaml.YAMLError("it has several documents, expected one")
        return value

    def _value(self) -> Any:
        event = self._loader.get_event()
        place = f"line {event.start_mark.line + 1}"
        if isinstance(event, yaml.AliasEvent) or event.anchor is not None:
            raise yaml.YAMLError(f"an anchor or alias at {place}, expected the value itself")
        if event.tag is not None:
            raise yaml.YAMLError(f"the tag {event.tag!r:.40} at {place}, expected a value without one")
        if isinstance(event, yaml.ScalarEvent):
            return plain_value(event.value) if event.implicit[0] else event.value
        self._levels += 1
        if self._levels > MOST_LEVELS:
            raise yaml.YAMLError(f"more than {MOST_LEVELS} levels at {place}, expected fewer")
        value = self._list() if isinstance(event, yaml.SequenceStartEvent) else self._mapping(place)
        self._levels -= 1
        return value

    def _list(self) -> list[Any]:
        values = []
        while not self._loader.check_event(yaml.SequenceEndEvent):
            values.append(self._value())
        self._loader.get_event()
        return values

    def _mapping(self, place: str) -> dict[Any, Any]:
        values: dict[Any, Any] = {}
        while not self._loader.check_event(yaml.MappingEndEvent):
            key = self._value()
            named = not isinstance(key, str) or (key.isprintable() and len(key) <= LONGEST_KEY)
            if isinstance(key, (dict, list)) or not named:
                raise yaml.YAMLError(f"the key {key!r:.40} in the mapping at {place}, expected a word or a number")
            if key in values:
                raise yaml.YAMLError(f"the key {key!r:.40} is written twice in the mapping at {place}")
            values[key] = self._value()
        self._loader.get_event()
        return values
