"""Suites by name, and from a config to its tasks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeVar

from switchmt_snn.config import SuiteDefaults, TasksConfig
from switchmt_snn.config.plugins import is_plugin, load_plugin, plugin_name
from switchmt_snn.config.suites import register_defaults, require_suite_name
from switchmt_snn.errors import ConfigError, TaskError, did_you_mean
from switchmt_snn.tasks.atari import AtariSuite
from switchmt_snn.tasks.changing import all_names, changing
from switchmt_snn.tasks.facts import is_outside, require_facts, require_tasks, suite_code
from switchmt_snn.tasks.gym import GymSuite
from switchmt_snn.tasks.minatar import MinAtarSuite
from switchmt_snn.tasks.suite import Suite, TaskSuite

_BUILT_IN: tuple[type[Suite], ...] = (AtariSuite, MinAtarSuite, GymSuite)
SUITES: dict[str, type[Suite]] = {suite.name: suite for suite in _BUILT_IN}
"""By name: the built-in suites, and those that ``register_suite`` added."""

AnySuite = TypeVar("AnySuite", bound=type[Suite])


def register_suite(suite: AnySuite) -> AnySuite:
    """Make a suite from outside the package known by its short name; also a class decorator.

    The short name holds in this process. A run stores ``package.module:Name``, so the command line resumes it if the
    module can be imported (it is installed, or its folder is in PYTHONPATH).

    Raises:
        ConfigError: not a complete ``Suite``, a local class, or a name that another
            suite has.
    """
    _require_complete(suite)
    stored_name = plugin_name(suite, "tasks.suite")
    other = SUITES.get(suite.name)
    if is_plugin(suite.name) or (other is not None and plugin_name(other, "tasks.suite") != stored_name):
        raise ConfigError(f"the suite {stored_name} has the name {suite.name!r}, expected a free short name; rename it")
    SUITES[suite.name] = suite
    register_defaults(suite.name, stored_name, suite.defaults)
    return suite


def find_suite(name: str) -> type[Suite]:
    """The suite that ``tasks.suite`` names; one from outside the package is imported.

    Raises:
        ConfigError: no such suite.
    """
    if name in SUITES:
        return SUITES[name]
    require_suite_name(name)
    suite: type[Suite] = load_plugin(name, "tasks.suite")
    _require_complete(suite)
    return suite


def suite_of(config: TasksConfig) -> Suite:
    """The suite of a config: its facts under these settings.

    Raises:
        TaskError: the constructor of a suite from outside the package fails.
    """
    suite = find_suite(config.suite)
    with suite_code(suite, config.suite, "its constructor"):
        return suite(config)


def make_suite(config: TasksConfig) -> TaskSuite:
    """Make the tasks that a config names; with ``tasks.later_names`` they know what they become (``TaskSuite.at``).

    Raises:
        ConfigError: unknown suite, or one that does not follow ``tasks.minimal_action_mask`` or ``tasks.wrappers``.
        TaskError: a task is unknown, does not fit a Q-network, or is not what its suite says.
        MissingExtraError: the suite needs an optional package.
    """
    if not config.later_names:
        return _made(config)
    both = replace(config, names=all_names(config), later_names=(), later_from_steps=None)
    return changing(_made(both), config)


def _made(config: TasksConfig) -> TaskSuite:
    """The tasks of a config in which none changes."""
    suite = suite_of(config)
    with suite_code(type(suite), config.suite, "known_tasks"):
        known = suite.known_tasks()
    if is_outside(type(suite)):
        require_facts(suite, config)
    for name in config.names:
        if name not in known and not suite.open_names:
            raise TaskError(f"tasks.names has the unknown {suite.name} task {name!r}{_hint(name, known)}")
    if config.minimal_action_mask and not suite.masks_actions:
        raise ConfigError(
            f"tasks.minimal_action_mask is True, expected false for the suite {config.suite!r}, which states no "
            "minimal actions (masks_actions)"
        )
    for key, asked in (
        ("wrappers", bool(config.wrappers)),
        ("image_layout", config.image_layout == "channels_first"),
        ("subprocesses", config.subprocesses),
    ):
        if asked and not suite.takes_wrappers:
            raise ConfigError(
                f"tasks.{key} is {getattr(config, key)!r}, expected the default for the suite {config.suite!r}, whose "
                "environments are no Gymnasium environments (takes_wrappers)"
            )
    with suite_code(type(suite), config.suite, "make"):
        tasks = suite.make()
    return require_tasks(tasks, config)


def _hint(name: str, known: Sequence[str]) -> str:
    """The suite that has a task of that name, or near names."""
    for suite in _BUILT_IN:
        if name in suite.known_tasks() or (suite is GymSuite and ":" in name):
            return f", expected one of that suite; tasks.suite={suite.name} has it"
    return did_you_mean(name, known)


def _require_complete(suite: object) -> None:
    if not (isinstance(suite, type) and issubclass(suite, Suite)):
        raise ConfigError(f"tasks.suite is {suite!r}, expected a subclass of switchmt_snn.tasks.suite.Suite")
    for attribute, kind in (("name", str), ("defaults", SuiteDefaults), ("examples", tuple)):
        if not isinstance(getattr(suite, attribute, None), kind):
            raise ConfigError(
                f"the suite {suite.__qualname__!r} states no {attribute}, expected a {kind.__name__}; "
                "see docs/extending.md"
            )
    if suite.make is Suite.make:
        raise ConfigError(f"the suite {suite.__qualname__!r} defines no make, expected make(self) -> TaskSuite")
