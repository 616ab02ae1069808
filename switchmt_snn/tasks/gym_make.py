"""Gymnasium environments by task name, within the wrappers that a config asks for."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec, find_highest_version, get_env_id, load_env_creator, parse_env_id

from switchmt_snn.config.plugins import import_plugin_module, is_plugin, load_plugin, user_code
from switchmt_snn.config.tasks import BUILT_IN_WRAPPERS
from switchmt_snn.errors import TaskError, did_you_mean, nearest
from switchmt_snn.tasks.gym_copies import Env
from switchmt_snn.tasks.randomness import OwnGenerators

_FORM = re.compile(r"(?:(?P<module>[^\W\d]\w*(?:\.[^\W\d]\w*)*):)?(?P<id>(?:[\w-]+/)?\w[\w.-]*)")
"""Of a task id: the module that registers it, then Gymnasium's namespace and name."""
LONGEST_ID = 120
"""Characters of a task id; the longest of Gymnasium have 40."""
MOST_COMBINATIONS = 512
"""Most actions that ``FlattenAction`` makes: a Q-network has an output for each."""
PICTURES = "rgb_array"
"""Gymnasium's name of the mode in which ``render`` gives pictures."""


class FlattenAction(gymnasium.ActionWrapper[Any, int, Any]):
    """One action for every combination of a ``MultiDiscrete`` or ``MultiBinary`` space; the last component moves first.

    Action a of ``MultiDiscrete([2, 3])`` is ``(a // 3, a % 3)``, plus the space's ``start``.
    """

    def __init__(self, env: Env) -> None:
        """Wrap an environment.

        Raises:
            TaskError: another action space, or more than ``MOST_COMBINATIONS`` combinations.
        """
        super().__init__(env)
        space = env.action_space
        if isinstance(space, gymnasium.spaces.MultiDiscrete):
            sizes, self._start = np.asarray(space.nvec), np.asarray(space.start)
        elif isinstance(space, gymnasium.spaces.MultiBinary):
            sizes = np.full(space.shape, 2)
            self._start = np.zeros(space.shape, np.int64)
        else:
            raise TaskError(f"FlattenAction meets the action space {space}, expected MultiDiscrete or MultiBinary")
        self._shape, self._dtype = sizes.shape, space.dtype
        self._sizes = tuple(int(size) for size in sizes.reshape(-1))
        count = int(np.prod(np.asarray(self._sizes, np.float64)))
        if count > MOST_COMBINATIONS:
            raise TaskError(
                f"FlattenAction would make {count:,} actions of {space}, expected at most {MOST_COMBINATIONS}; choose "
                "some of them in a wrapper of your own (gymnasium.ActionWrapper; tasks.wrappers=[module:Name])"
            )
        self.action_space: gymnasium.Space[Any] = gymnasium.spaces.Discrete(count)

    def action(self, action: int) -> Any:
        """The combination that an action stands for."""
        parts = np.asarray(np.unravel_index(int(action), self._sizes)).reshape(self._shape)
        return (parts + self._start).astype(self._dtype)


WRAPPERS: dict[str, Callable[[Env], Env]] = {
    "FlattenObservation": gymnasium.wrappers.FlattenObservation,
    "FlattenAction": FlattenAction,
}
"""What ``tasks.wrappers`` names without a module: ``BUILT_IN_WRAPPERS`` of the config."""
assert tuple(WRAPPERS) == BUILT_IN_WRAPPERS


def parse_id(name: str) -> tuple[str | None, str]:
    """A task id of the gym suite as its module and Gymnasium's id.

    Raises:
        TaskError: another form.

    Examples:
        >>> parse_id("my_module:MyEnv-v0"), parse_id("ALE/Pong-v5")
        (('my_module', 'MyEnv-v0'), (None, 'ALE/Pong-v5'))
    """
    found = _FORM.fullmatch(name)
    if found is None or len(name) > LONGEST_ID:
        raise TaskError(
            f"tasks.names has {name!r:.80}, expected an id such as CartPole-v1, or module:Id, such as "
            "my_module:MyEnv-v0, which imports my_module first"
        )
    return found["module"], found["id"]


def make_environment(name: str, wrappers: Sequence[str] = (), pictured: bool = False) -> Env:
    """One environment of the gym suite, as training plays it.

    Args:
        name: ``EnvId``, or ``module:EnvId``, which imports ``module`` first, as Gymnasium does.
        wrappers: as ``tasks.wrappers``: ``FlattenObservation``, ``FlattenAction``, or ``module:Name``; the first is the
            innermost.
        pictured: make it draw (``render_mode="rgb_array"``), if it can.

    Raises:
        TaskError: the id is unknown, or the environment or a wrapper cannot be made.

    Examples:
        >>> make_environment("Blackjack-v1", ["FlattenObservation"]).observation_space.shape
        (45,)
    """
    module, env_id = parse_id(name)
    if module is not None:
        _import(name, module)
    expected = "a Gymnasium environment with observation_space and action_space"
    with OwnGenerators():  # what a constructor draws (a maze) is the same each time
        with user_code(f"task {name!r} cannot be made", expected, TaskError):
            env = _registered(name, env_id, pictured)
        for wrapper in wrappers:
            env = _wrapped(name, env, wrapper)
    return env


def _registered(name: str, env_id: str, pictured: bool) -> Env:
    try:
        if pictured:
            os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")  # pygame greets on stdout
        options: dict[str, Any] = {"render_mode": PICTURES} if pictured and _draws(env_id) else {}
        env: Env = gymnasium.make(env_id, **options)
    except gymnasium.error.DependencyNotInstalled as error:
        raise TaskError(f"task {name!r} needs a package that is not installed ({error})") from error
    except ImportError as error:
        raise TaskError(f"task {name!r} cannot be made ({error}), expected all its packages; install them") from error
    except gymnasium.error.DeprecatedEnv as error:
        raise TaskError(
            f"tasks.names has the old Gymnasium id {name!r} ({error}), expected its newest version"
        ) from error
    except gymnasium.error.UnregisteredEnv as error:
        raise TaskError(f"tasks.names has the unknown Gymnasium id {name!r}{_hint(name)}") from error
    return env


def spec_of(env_id: str) -> EnvSpec | None:
    """What is registered under an id, or without a version its newest, as gymnasium.make takes it; None if nothing."""
    if env_id in gymnasium.registry:
        return gymnasium.registry[env_id]
    namespace, name, version = parse_env_id(env_id)
    newest = find_highest_version(namespace, name) if version is None else None
    return None if newest is None else gymnasium.registry.get(get_env_id(namespace, name, newest))


def _draws(env_id: str) -> bool:
    """Whether an environment says that it can give pictures; its class is imported for that."""
    spec = spec_of(env_id)
    point = None if spec is None else spec.entry_point
    made = load_env_creator(point) if isinstance(point, str) else point
    metadata = getattr(made, "metadata", None)
    return isinstance(metadata, dict) and PICTURES in metadata.get("render_modes", ())


def _wrapped(name: str, env: Env, wrapper: str) -> Env:
    make = load_plugin(wrapper, "tasks.wrappers") if is_plugin(wrapper) else WRAPPERS[wrapper]
    expected = f"one for {env.observation_space} and {env.action_space}"
    with user_code(f"task {name!r} does not take the wrapper {wrapper}", expected, TaskError):
        try:
            wrapped = make(env)
        except TaskError as error:
            raise TaskError(f"task {name!r}: {error}") from error
    if not isinstance(wrapped, gymnasium.Env):
        raise TaskError(
            f"tasks.wrappers has {wrapper}, which made a {type(wrapped).__name__}, expected a gymnasium.Env"
        )
    return wrapped


def _import(name: str, module: str) -> None:
    try:
        import_plugin_module(module)
    except ImportError as error:
        missing = getattr(error, "name", None)
        itself = missing is not None and f"{module}.".startswith(f"{missing}.")
        needs = "mend the module, or give it what it needs (a package, a display)"
        remedy = "install it, or add its folder to PYTHONPATH" if itself else needs
        raise TaskError(
            f"tasks.names has {name!r}, expected an importable module before the colon, but importing {module!r} fails "
            f"({error}); {remedy}"
        ) from error


def _hint(name: str) -> str:
    """Near ids: after ``module:``, of those whose class lies in the module."""
    module, _ = parse_id(name)
    if module is None:
        return (
            f"; an id that a module registers is named module:Id, such as my_module:{name}"
            f"{nearest(name, gymnasium.registry)}"
        )
    old = getattr(getattr(sys.modules.get("gym"), "envs", None), "registry", ())
    if parse_id(name)[1] in old:
        return (
            f"; {module!r} registers it in gym, which came before Gymnasium; use a version of it for Gymnasium, or "
            "register a class of yours that plays it"
        )
    own = [
        f"{module}:{env_id}"
        for env_id, spec in gymnasium.registry.items()
        if (
            spec.entry_point if isinstance(spec.entry_point, str) else getattr(spec.entry_point, "__module__", "")
        ).partition(":")[0]
        == module
    ]
    return (
        did_you_mean(name, own)
        if own
        else f"; {module!r} registers none of its classes; call gymnasium.register(id, MyEnv, max_episode_steps=...)"
        f"{_inner_modules(module)}"
    )


def _inner_modules(package: str) -> str:
    """A module of a package that registers what the package itself does not, by its text."""
    for place in getattr(sys.modules.get(package), "__path__", ()):
        for file in (*Path(place).glob("*/__init__.py"), *Path(place).glob("*.py")):
            inner = file.parent.name if file.name == "__init__.py" else file.stem
            if inner != Path(place).name and "register(" in file.read_text("utf-8", errors="ignore"):
                return f", or name a module that does: it seems that {package}.{inner} does"
    return ""
