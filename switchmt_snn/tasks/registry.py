"""Suites by name, and from a config to its tasks."""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from switchmt_snn.config import SuiteDefaults, TasksConfig, resolved_frame_stack
from switchmt_snn.config.plugins import is_plugin, load_plugin, plugin_name
from switchmt_snn.config.suites import register_defaults, require_suite_name
from switchmt_snn.errors import ConfigError, TaskError, did_you_mean
from switchmt_snn.tasks.atari import AtariSuite
from switchmt_snn.tasks.gym import GymSuite
from switchmt_snn.tasks.minatar import MinAtarSuite
from switchmt_snn.tasks.suite import Suite, TaskSuite

SUITES: dict[str, type[Suite]] = {suite.name: suite for suite in (AtariSuite, MinAtarSuite, GymSuite)}
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
    """The suite of a config: its facts under these settings."""
    return find_suite(config.suite)(config)


def make_suite(config: TasksConfig) -> TaskSuite:
    """Make the tasks that a config names.

    Raises:
        ConfigError: unknown suite, or one that does not follow ``tasks.minimal_action_mask`` or ``tasks.wrappers``.
        TaskError: a task is unknown, does not fit a Q-network, or is not what its suite says.
        MissingExtraError: the suite needs an optional package.
    """
    suite = suite_of(config)
    known = suite.known_tasks()
    for name in config.names:
        if name not in known and not suite.open_names:
            raise TaskError(f"tasks.names has the unknown {suite.name} task {name!r}{did_you_mean(name, known)}")
    if config.minimal_action_mask and not suite.masks_actions:
        raise ConfigError(
            f"tasks.minimal_action_mask is True, expected false for the suite {config.suite!r}, which states no "
            "minimal actions (masks_actions)"
        )
    for key, asked in (("wrappers", bool(config.wrappers)), ("image_layout", config.image_layout == "channels_first")):
        if asked and not suite.takes_wrappers:
            raise ConfigError(
                f"tasks.{key} is {getattr(config, key)!r}, expected the default for the suite {config.suite!r}, whose "
                "environments are no Gymnasium environments (takes_wrappers)"
            )
    tasks = suite.make()
    stack, shape = resolved_frame_stack(config), tasks.valid_actions_KA.shape
    readable = all(name and name.isprintable() and not set(name) & set(',"') for name in tasks.names)
    checks = (
        (readable, f"names {tasks.names}", "printable names without commas and quotes, which tables could not hold"),
        (tasks.names == config.names, f"names {tasks.names}", f"those of the config, {config.names}"),
        (tasks.frame_stack == stack, f"frame_stack {tasks.frame_stack}", f"{stack}"),
        (len(tasks.frame_shape) in (1, 3), f"frame_shape {tasks.frame_shape}", "(features,) or (channels, H, W)"),
        (np.dtype(tasks.frame_dtype) in (np.uint8, np.float32), f"frame_dtype {tasks.frame_dtype}", "uint8 or float32"),
        (
            shape == (len(tasks.names), tasks.num_actions) and bool(tasks.valid_actions_KA.any(axis=1).all()),
            f"valid_actions_KA {tasks.valid_actions_KA.tolist()}",
            "a row per task and a column per action, at least one action true in each row",
        ),
        (
            len(tasks.first_actions) in (0, len(tasks.names)),
            f"first_actions {tasks.first_actions}",
            f"none, or one for each of {len(tasks.names)} tasks",
        ),
    )
    for holds, seen, expected in checks:
        if not holds:
            raise TaskError(f"the suite {config.suite!r} makes tasks of {seen}, expected {expected}; change its make()")
    return tasks


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
