"""Classes by the name that a setting takes: one form for encodings, neurons and switching criteria."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, TypeVar

from switchmt_snn.config.checks import choices, field_types
from switchmt_snn.config.plugins import is_plugin, load_plugin
from switchmt_snn.errors import ConfigError, nearest

T = TypeVar("T", bound=type[Any])


class Registry(Mapping[str, T]):
    """The classes of this package that one setting names, and the way to those from outside.

    The setting's field in the config lists the names, because a config is checked before the classes are imported.
    """

    def __init__(self, section: type[Any], key: str, check: Callable[[Any, str], T]) -> None:
        """An empty registry.

        Args:
            section: the config class that has the setting.
            key: the setting, as ``network.encoding``.
            check: takes a class and its name; returns the class, or raises ConfigError if it is none of the kind, or
                not whole.
        """
        self.key = key
        self._check = check
        self._field = key.rpartition(".")[2]
        self._section = section
        self._names = choices(field_types(section)[self._field])
        self._classes: dict[str, T] = {}

    def register(self, name: str) -> Callable[[T], T]:
        """Class decorator: makes a class of this package known by a name.

        Raises:
            ConfigError: the setting does not take the name, the name is taken, or the class is not whole.
        """

        def register(cls: T) -> T:
            if name not in self._names:
                raise ConfigError(
                    f"{self._field} {name!r} is not a value of {self.key}, expected one of {', '.join(self._names)}; "
                    f"add it to the field {self._field} of {self._section.__module__}.{self._section.__name__}, or use "
                    "package.module:Class"
                )
            if self._classes.get(name, cls) is not cls:
                raise ConfigError(
                    f"{self._field} {name!r} is {self._classes[name].__name__}, expected a name that is free"
                )
            self._classes[name] = self._check(cls, name)
            return cls

        return register

    def find(self, name: str) -> T:
        """The class that the setting's value names: of this package, or ``package.module:Class``.

        Raises:
            ConfigError: the name is unknown, cannot be imported, or is no such class.
        """
        if name in self._classes:
            return self._classes[name]
        if is_plugin(name):
            return self._check(load_plugin(name, self.key), name)
        raise ConfigError(
            f"{self.key} is {name!r}, expected one of {', '.join(self._classes)}, or package.module:Class"
            f"{nearest(str(name), self._classes)}"
        )

    def __getitem__(self, name: str) -> T:
        return self._classes[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._classes)

    def __len__(self) -> int:
        return len(self._classes)
