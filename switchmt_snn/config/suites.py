"""Task suites by name, as far as a config needs them: what null and ``auto`` mean in each suite.

The suites themselves are above this package, in ``switchmt_snn.tasks``.
"""

from __future__ import annotations

from dataclasses import dataclass

from switchmt_snn.config.plugins import is_plugin, load_plugin
from switchmt_snn.errors import ConfigError, nearest


@dataclass(frozen=True)
class SuiteDefaults:
    """Settings that a suite chooses where a config leaves them open.

    Attributes:
        frame_stack: newest frames that form one observation (``tasks.frame_stack: null``).
        trunk: feature layers (``network.trunk: auto``): ``nature``, ``minatar`` or ``mlp``.
        clip_rewards: whether rewards are clipped to [-1, 1] for learning (``learning.clip_rewards: null``).
    """

    frame_stack: int
    trunk: str
    clip_rewards: bool = False


SUITE_DEFAULTS: dict[str, SuiteDefaults] = {
    "atari": SuiteDefaults(frame_stack=4, trunk="nature", clip_rewards=True),
    "minatar": SuiteDefaults(frame_stack=1, trunk="minatar", clip_rewards=True),
    "gym": SuiteDefaults(frame_stack=1, trunk="mlp", clip_rewards=False),
}
"""By name: the built-in suites, and those that ``register_suite`` added."""

_STORED_NAMES: dict[str, str] = {}


def register_defaults(name: str, stored_name: str, defaults: SuiteDefaults) -> None:
    """Make a suite from outside the package known by a short name.

    Args:
        name: value of ``tasks.suite``, in this process only.
        stored_name: ``package.module:Name``, which a run's config holds instead, so that any process can resume it.
        defaults: what the suite chooses.
    """
    SUITE_DEFAULTS[name] = defaults
    _STORED_NAMES[name] = stored_name


def require_suite_name(name: object) -> None:
    """Refuse a value that ``tasks.suite`` does not take: neither a known name nor ``package.module:Name``.

    Raises:
        ConfigError: naming the known suites.
    """
    if name not in SUITE_DEFAULTS and not is_plugin(name):
        raise unknown_suite(name)


def unknown_suite(name: object) -> ConfigError:
    """The error for a value that ``tasks.suite`` does not take."""
    known = ", ".join(SUITE_DEFAULTS)
    hint = nearest(str(name), SUITE_DEFAULTS)
    return ConfigError(f"tasks.suite is {name!r}, expected {known}, or a class as package.module:Name{hint}")


def stored_suite_name(name: str) -> str:
    """The name under which every process finds the suite."""
    return _STORED_NAMES.get(name, name)


def suite_defaults(name: str) -> SuiteDefaults:
    """What a suite chooses where a config leaves a setting open; imports a suite from outside the package.

    Raises:
        ConfigError: no such suite, or a class that states no defaults.
    """
    require_suite_name(name)
    if name in SUITE_DEFAULTS:
        return SUITE_DEFAULTS[name]
    defaults = getattr(load_plugin(name, "tasks.suite"), "defaults", None)
    if not isinstance(defaults, SuiteDefaults):
        raise ConfigError(
            f"tasks.suite is {name!r}, expected a class with defaults = SuiteDefaults(...), but its defaults are "
            f"{defaults!r}; see docs/extending.md"
        )
    return defaults
