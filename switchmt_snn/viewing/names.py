"""How tasks are named in tables and figures."""

from __future__ import annotations

from collections.abc import Sequence


def shown_task(task: str, tasks: Sequence[str]) -> str:
    """A task's name without its module (``module:Env-v0``), where that still tells it from the others.

    Examples:
        >>> shown_task("my.games:Maze-v0", ["CartPole-v1", "my.games:Maze-v0"])
        'Maze-v0'
    """
    short = task.rsplit(":", 1)[-1]
    return short if sum(other.rsplit(":", 1)[-1] == short for other in tasks) == 1 else task
