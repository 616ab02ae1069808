"""Any Gymnasium environments with discrete actions and image or vector observations, padded to one shape."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.envs.registration import EnvSpec

from switchmt_snn.config import resolved_frame_stack
from switchmt_snn.config.plugins import import_plugin_module, is_plugin
from switchmt_snn.config.suites import SUITE_DEFAULTS
from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.changing import all_names
from switchmt_snn.tasks.contract import gymnasium_code
from switchmt_snn.tasks.gym_copies import Env, GymCopies, GymCopy, first_action, is_inside, is_outside
from switchmt_snn.tasks.gym_make import make_environment, parse_id, spec_of
from switchmt_snn.tasks.gym_processes import GymProcesses
from switchmt_snn.tasks.gym_spaces import FrameLayout, frame_layout, num_actions
from switchmt_snn.tasks.suite import Suite, TaskEnvironment, TaskSuite


class GymSuite(Suite):
    """Gymnasium ids; ``my_module:MyEnv-v0`` imports ``my_module``, which registers the id, first."""

    name = "gym"
    defaults = SUITE_DEFAULTS["gym"]
    examples = ("CartPole-v1", "Acrobot-v1")
    open_names = True
    packages = ("gymnasium",)
    takes_wrappers = True

    @classmethod
    def known_tasks(cls) -> tuple[str, ...]:
        """Ids that are registered now."""
        return tuple(gymnasium.registry)

    @property
    def files(self) -> dict[str, Path]:
        """The modules that tasks and wrappers name before a colon."""
        modules = [parse_id(name)[0] for name in all_names(self.config)]
        modules += [name.partition(":")[0] for name in self.config.wrappers if is_plugin(name)]
        named = [module for module in dict.fromkeys(modules) if module is not None]
        files = {module: getattr(import_plugin_module(module), "__file__", None) for module in named}
        return {module: Path(file) for module, file in files.items() if file is not None}  # a built-in one has none

    @property
    def registered(self) -> dict[str, str]:
        """How each id is registered now: its class, arguments, limit of steps and wrappers."""
        return {name: repr(spec_of(parse_id(name)[1])) for name in all_names(self.config)}

    def make(self) -> TaskSuite:
        """Make the environments.

        Raises:
            TaskError: an id is unknown or cannot be made, actions are not discrete, observations are not boxes of one
                to three dimensions, or images and vectors are mixed.
        """
        names, wrappers = self.config.names, self.config.wrappers
        probes = [make_environment(name, wrappers) for name in names]
        counts = [num_actions(name, env.action_space, wrappers) for name, env in zip(names, probes, strict=True)]
        layouts = [
            frame_layout(name, env.observation_space, self.config.image_layout, wrappers)
            for name, env in zip(names, probes, strict=True)
        ]
        first_actions = tuple(first_action(env) for env in probes)
        wrapped_outside = any(not is_inside(name.partition(":")[0]) for name in wrappers if is_plugin(name))
        outside = [
            wrapped_outside or is_outside(env) or not is_inside(parse_id(name)[0] or "gymnasium")
            for name, env in zip(names, probes, strict=True)
        ]
        _require_different(names, probes)
        for name, env in zip(names, probes, strict=True):
            with gymnasium_code(name, "close"):
                env.close()
        _require_one_kind(names, layouts)
        frame_shape = tuple(int(side) for side in np.max(np.asarray([layout.shape for layout in layouts]), axis=0))
        is_image = layouts[0].is_image
        dtype: npt.DTypeLike = np.uint8 if is_image else np.float32

        def copy_of(task: int, pictured: bool = False) -> Callable[[], GymCopy]:
            spec = spec_of(parse_id(names[task])[1])
            return partial(
                _copy, names[task], spec, wrappers, pictured, frame_shape, dtype, layouts[task], outside[task]
            )

        def make(task: int, num_envs: int) -> TaskEnvironment:
            if self.config.subprocesses:
                return GymProcesses(names[task], copy_of(task), num_envs)
            return GymCopies([copy_of(task)() for _ in range(num_envs)])

        return TaskSuite(
            names=names,
            frame_shape=frame_shape,
            frame_dtype=dtype,
            frame_stack=resolved_frame_stack(self.config),
            scale=layouts[0].scale,
            in_unit_range=is_image,
            action_names=_action_names(max(counts), first_actions),
            valid_actions_KA=np.arange(max(counts))[None, :] < np.asarray(counts)[:, None],
            references={},
            make=make,
            first_actions=first_actions,
            thread_safe=not any(outside),
            versioned=not any(outside),
            make_pictured=lambda task, num_envs: GymCopies([copy_of(task, True)() for _ in range(num_envs)]),
        )


def _copy(
    name: str,
    spec: EnvSpec | None,
    wrappers: tuple[str, ...],
    pictured: bool,
    frame_shape: tuple[int, ...],
    frame_dtype: npt.DTypeLike,
    layout: FrameLayout,
    outside: bool,
) -> GymCopy:
    """A copy of an environment, also in a process that has not registered its id."""
    module, _ = parse_id(name)
    if spec is not None:
        with contextlib.suppress(ImportError):  # told below
            if module is not None:  # first: registering an id again is a warning
                import_plugin_module(module)
        gymnasium.registry.setdefault(spec.id, spec)
    env = make_environment(name, wrappers, pictured)
    return GymCopy(name, env, frame_shape, frame_dtype, layout.frame, outside=outside)


def _require_different(names: tuple[str, ...], probes: list[Env]) -> None:
    """Refuse two names of one environment."""
    seen: dict[str, str] = {}
    for name, env in zip(names, probes, strict=True):
        env_id = name if env.unwrapped.spec is None else env.unwrapped.spec.id
        if seen.setdefault(env_id, name) != name:
            raise TaskError(f"tasks {seen[env_id]} and {name} are both {env_id}, expected every task once")


def _require_one_kind(names: tuple[str, ...], layouts: list[FrameLayout]) -> None:
    if len({layout.is_image for layout in layouts}) > 1:
        raise TaskError(f"tasks {', '.join(names)} mix images and vectors, expected one kind in one network")
    if len({layout.scale for layout in layouts}) > 1:
        raise TaskError(f"tasks {', '.join(names)} mix images of uint8 and of bool, expected one kind in one network")


def _action_names(count: int, first_actions: tuple[int, ...]) -> tuple[str, ...]:
    """The environments' numbers, if they agree on the first; else numbered outputs."""
    if len(set(first_actions)) > 1:
        return tuple(f"output_{a}" for a in range(count))
    return tuple(f"action_{first_actions[0] + a}" for a in range(count))
