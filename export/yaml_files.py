"""Strict reading of YAML files of facts (energy targets, chips): every mistake is one line that names file and key."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from importlib import resources
from pathlib import Path
from typing import Any, Generic, Protocol, TypeVar

from switchmt_snn.config.strict_yaml import parse_yaml, read_text
from switchmt_snn.errors import ConfigError, did_you_mean

SUFFIXES = (".yaml", ".yml")


class Named(Protocol):
    """What a file of facts describes."""

    @property
    def name(self) -> str:
        """Its name in tables and lists, which finds a built-in one."""


T = TypeVar("T", bound=Named)


class Catalog(Generic[T]):
    """What one kind of YAML files describes, such as chips: the files of a package, and those of a user.

    Args:
        kind: in words, as ``energy target``, for errors.
        package: the package whose files are the built-in ones.
        read: makes one from what ``parse`` gave and the file's name for errors, or raises ConfigError.
    """

    def __init__(self, kind: str, package: str, read: Callable[[Any, str], T]) -> None:
        self.kind, self.read = kind, read
        self._package = package

    @cached_property
    def built_in(self) -> dict[str, T]:
        """Those that come with the package, by name, in the order of their files' names."""
        files = [entry for entry in resources.files(self._package).iterdir() if entry.name.endswith(SUFFIXES)]
        ordered = sorted(files, key=lambda entry: entry.name)
        found = [self.read(parse(entry.read_text(encoding="utf-8"), entry.name), entry.name) for entry in ordered]
        return {one.name: one for one in found}

    def load(self, name_or_file: str | Path) -> T:
        """A built-in one by name, or one from a YAML file.

        Raises:
            ConfigError: no such one, or a file that does not describe one.
        """
        name = str(name_or_file)
        if Path(name).suffix in SUFFIXES:
            return self.read(parse(file_text(name), name), name)
        if name not in self.built_in:
            raise ConfigError(f"unknown {self.kind} {name!r}{did_you_mean(name, self.built_in)}")
        return self.built_in[name]

    def own(self, described: T, file: str) -> T:
        """What a user's file describes, if its name does not stand for other numbers that come with the package.

        Raises:
            ConfigError: it does.
        """
        if self.built_in.get(described.name, described) != described:
            raise ConfigError(
                f"{file}: name is {described.name!r}, which is a built-in {self.kind} with other numbers, expected a "
                "name of its own; change the name in your file"
            )
        return described


def file_text(path: str | Path) -> str:
    """Text of a file.

    Raises:
        ConfigError: it cannot be read, is too large, or is not UTF-8.
    """
    return read_text(path, "an energy target or a chip")


def parse(text: str, where: str) -> dict[str, Any]:
    """The keys and values of a YAML text.

    Raises:
        ConfigError: it is not YAML (see ``switchmt_snn.config.strict_yaml``), has a key twice, or holds no keys.
    """
    raw = parse_yaml(text, where, "an energy target or a chip")
    if not isinstance(raw, dict):
        raise ConfigError(f"{where}: the file is {raw!r:.60}, expected keys and values")
    return raw


class Section:
    """Keys and values of one mapping of a file. Every read checks the type and names the key in its error.

    Args:
        where: name of the file, for errors.
        raw: the mapping.
        prefix: path of the mapping in the file, ending in a dot; empty for the whole file.
        needed, optional: all keys that the mapping may have; None takes any key (a mapping of names).

    Raises:
        ConfigError: ``raw`` is no mapping, or a key is unknown or missing.
    """

    def __init__(
        self, where: str, raw: Any, prefix: str = "", needed: Sequence[str] = (), optional: Sequence[str] | None = ()
    ) -> None:
        if not isinstance(raw, dict):
            raise ConfigError(f"{where}: {prefix.rstrip('.') or 'the file'} is {raw!r:.60}, expected keys and values")
        self.where, self.raw, self._prefix = where, raw, prefix
        known = (*needed, *(optional or ()))
        for key in raw:
            if optional is not None and key not in known:
                raise ConfigError(f"{where} has the unknown key {prefix}{key}{did_you_mean(str(key), known)}")
        for key in needed:
            if key not in raw:
                raise ConfigError(f"{where} has no {prefix}{key}, expected one; docs/energy.md lists all keys")

    def __contains__(self, key: str) -> bool:
        return self.raw.get(key) is not None

    def name(self, key: str) -> str:
        """Path of a key in the file."""
        return f"{self._prefix}{key}"

    def wrong(self, key: str, expected: str) -> ConfigError:
        """The error of a value that is not what was expected."""
        return ConfigError(f"{self.where}: {self.name(key)} is {self.raw[key]!r:.60}, expected {expected}")

    def section(self, key: str, needed: Sequence[str] = (), optional: Sequence[str] | None = ()) -> Section:
        """The mapping under a key; arguments as of the class."""
        return Section(self.where, self.raw[key], f"{self.name(key)}.", needed, optional)

    def sections(self, key: str, needed: Sequence[str], optional: Sequence[str] = ()) -> list[Section]:
        """The mappings of a list with at least one."""
        items = self.raw[key]
        if not isinstance(items, list) or not items:
            raise self.wrong(key, "a list with at least one entry")
        return [Section(self.where, item, f"{self.name(key)}[{i}].", needed, optional) for i, item in enumerate(items)]

    def text(self, key: str, why: str = "") -> str:
        """A text that is not empty."""
        value = self.raw[key]
        if not isinstance(value, str) or not value.strip():
            raise self.wrong(key, f"a text{why}")
        return value

    def short_name(self, key: str) -> str:
        """A text that names the file's subject in tables and lists."""
        value = self.text(key)
        if not value.isprintable() or set(value) & set("/\\,"):
            raise self.wrong(key, "a name of one line without /, \\ and commas, such as my-target")
        return value

    def choice(self, key: str, allowed: Sequence[str]) -> str:
        """One of the allowed texts."""
        value = self.raw[key]
        if not isinstance(value, str) or value not in allowed:
            hint = did_you_mean(value, allowed) if isinstance(value, str) else ""
            raise self.wrong(key, f"one of {', '.join(allowed)}{hint if hint.startswith('; did') else ''}")
        return value

    def texts(self, key: str, allowed: Sequence[str] | None = None, empty: bool = False) -> tuple[str, ...]:
        """A list of texts, at least one unless it may be empty; all among the allowed ones, if these are given."""
        items = self.raw[key]
        listed = isinstance(items, list) and all(isinstance(item, str) and item for item in items)
        if not listed or not (items or empty):
            raise self.wrong(key, f"a list of texts{'' if empty else ' with at least one'}")
        for item in items:
            if allowed is not None and item not in allowed:
                raise ConfigError(f"{self.where}: {self.name(key)} has {item!r:.80}{did_you_mean(item[:80], allowed)}")
        return tuple(items)

    def number(self, key: str) -> float:
        """A number of at least 0, as it is written (a whole number stays one)."""
        return check_number(self.where, self.name(key), self.raw[key])

    def whole(self, key: str, low: int = 1, high: int = 10**15, of: str = "") -> int:
        """A whole number between two bounds; ``of`` is its unit, for the error."""
        value = self.raw[key]
        if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
            raise self.wrong(key, f"a whole number{of and f' of {of}'}, {low} to {high:,}")
        return value

    def flag(self, key: str) -> bool:
        """true or false."""
        value = self.raw[key]
        if not isinstance(value, bool):
            raise self.wrong(key, "true or false")
        return value


def check_number(where: str, name: str, value: Any) -> float:
    """The value, if it is a number of at least 0.

    Raises:
        ConfigError: it is not.
    """
    number = isinstance(value, (int, float)) and not isinstance(value, bool)
    if not number or not 0 <= value < 1e18:  # NaN is not
        hint = "; YAML reads 2e-3 as text: write 2.0e-3" if isinstance(value, str) else ""
        raise ConfigError(f"{where}: {name} is {value!r:.60}, expected a number of at least 0{hint}")
    return value  # type: ignore[no-any-return]
