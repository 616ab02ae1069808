"""Copies of a Gymnasium environment, each in a process of its own (Gymnasium's ``AsyncVectorEnv``), for slow ones.

The processes are forked from one server that has imported this package, so they share its memory, and they play what
copies in this process would play: the same ``GymCopy`` runs in them.
"""

from __future__ import annotations

import contextlib
import json
import multiprocessing
import signal
import warnings
from collections.abc import Callable, Iterator
from functools import cache, partial
from typing import Any, SupportsFloat, TextIO

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AsyncVectorEnv, AutoresetMode

from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.gym_copies import GymCopy
from switchmt_snn.tasks.suite import Frames, VectorStep


class GymProcesses:
    """Copies of one Gymnasium environment, stepped at the same time in processes of their own."""

    def __init__(self, name: str, make: Callable[[], GymCopy], num_envs: int) -> None:
        """Start the processes.

        Args:
            name: of the task, for errors.
            make: makes a copy; it is called in each process, and once here.
            num_envs: how many.

        Raises:
            TaskError: a process ends instead of making its copy.
        """
        self.num_envs = num_envs
        self._name = name
        methods = multiprocessing.get_all_start_methods()
        context = "forkserver" if "forkserver" in methods else "spawn"
        if context == "forkserver":
            multiprocessing.set_forkserver_preload([__name__])
        with self._answers():
            if context == "forkserver":
                _start_server()
            others = multiprocessing.active_children()
            try:
                self._vector = AsyncVectorEnv(
                    [partial(_here, make)] * num_envs, context=context, autoreset_mode=AutoresetMode.DISABLED
                )
            except BaseException:  # Ctrl-C: a process that starts would miss what is freed now, with a traceback
                for process in set(multiprocessing.active_children()) - set(others):
                    process.kill()
                    process.join()
                raise

    def reset(self, env_ids: npt.NDArray[np.int64], seeds: npt.NDArray[np.int64]) -> Frames:
        """Start new episodes with the given seeds."""
        chosen = np.zeros(self.num_envs, np.bool_)
        chosen[env_ids] = True
        every: list[int | None] = [None] * self.num_envs
        for env_id, seed in zip(env_ids.tolist(), seeds.tolist(), strict=True):
            every[env_id] = seed
        with self._answers():
            frames, infos = self._vector.reset(seed=every, options={"reset_mask": chosen})
        _warn_of(infos)
        found: Frames = frames[env_ids]
        return found

    def step(self, actions: npt.NDArray[np.int64]) -> VectorStep:
        """Step every copy."""
        with self._answers():
            frames, rewards, terminated, truncated, infos = self._vector.step(actions)
        _warn_of(infos)
        return VectorStep(frames, rewards, terminated, truncated)

    def close(self) -> None:
        """Close the copies and end their processes."""
        if hasattr(self, "_vector"):
            try:
                self._vector.close()
            except OSError:  # a process has ended before
                for process in self._vector.processes:
                    process.kill()

    @contextlib.contextmanager
    def _answers(self) -> Iterator[None]:
        """Around a question to the processes: one that has ended is an error; Gymnasium's own log is not shown."""
        level = gymnasium.logger.min_level
        gymnasium.logger.min_level = gymnasium.logger.ERROR + 1
        try:
            yield
        except (EOFError, ConnectionError) as error:
            raise TaskError(
                f"a process of task {self._name!r} has ended, expected one that lives as long as training; what it "
                "wrote is above; tasks.subprocesses=false plays without processes (a script that calls train needs "
                'the line if __name__ == "__main__": before it)'
            ) from error
        finally:
            gymnasium.logger.min_level = level


@cache
def _start_server() -> None:
    """Wait for the server's imports, which take seconds: Ctrl-C must not meet a copy that is not yet a process.

    Raises:
        EOFError: it cannot start a process.
    """
    process = multiprocessing.get_context("forkserver").Process(target=_nothing, daemon=True)
    process.start()
    process.join()
    if process.exitcode != 0:
        raise EOFError


def _nothing() -> None:
    """What the server's first process does."""


class _Reporting(gymnasium.Wrapper[Any, int, Any, int]):
    """A copy in a process of its own: its warnings go to the main process, which shows each of them once; every process
    would.
    """

    def __init__(self, copy: GymCopy, heard: list[_Heard]) -> None:
        super().__init__(copy)
        self._heard = heard

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        frame, _ = self.env.reset(seed=seed, options=options)
        return frame, self._told()

    def step(self, action: int) -> tuple[Any, SupportsFloat, bool, bool, dict[str, Any]]:
        frame, reward, terminated, truncated, _ = self.env.step(action)
        return frame, reward, terminated, truncated, self._told()

    def _told(self) -> dict[str, Any]:
        if not self._heard:
            return {}
        told = {_WARNINGS: json.dumps(self._heard)}
        self._heard.clear()
        return told


def _here(make: Callable[[], GymCopy]) -> _Reporting:
    """In a process of a copy: make it. Ctrl-C is for the main process, which ends the others."""
    heard: list[_Heard] = []
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)

        def hear(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            heard.append((str(message), filename, lineno))

        warnings.showwarning = hear
    return _Reporting(make(), heard)


_WARNINGS = "warnings"
"""In the info of a copy: what it was warned of, as JSON."""
_Heard = tuple[str, str, int]
"""A warning's text, file and line."""


def _warn_of(infos: dict[str, Any]) -> None:
    """Warn here of what the copies were warned of."""
    for text, file, line in sorted(
        {tuple(one) for told in infos.get(_WARNINGS, ()) if told for one in json.loads(told)}
    ):
        warnings.warn_explicit(text, UserWarning, file, line, registry=_shown)


_shown: dict[str | tuple[str, type[Warning], int], int] = {}
"""Where Python notes the warnings that were shown."""
