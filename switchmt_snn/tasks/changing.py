"""Tasks that change midway: one suite of the earlier and the later tasks, so that they share frames and outputs."""

from __future__ import annotations

from dataclasses import replace

from switchmt_snn.config import TasksConfig
from switchmt_snn.errors import TaskError
from switchmt_snn.tasks.suite import Later, TaskSuite


def all_names(config: TasksConfig) -> tuple[str, ...]:
    """Every task of a config that is played at some time, the earlier ones first."""
    return tuple(dict.fromkeys((*config.names, *config.later_names)))


def changing(both: TaskSuite, config: TasksConfig) -> TaskSuite:
    """The earlier tasks, which know what they become.

    Args:
        both: the tasks of ``all_names``.
        config: with ``later_names``.

    Raises:
        TaskError: a later task has other actions than the task that it follows.
    """
    names, count = config.names, len(config.names)
    places = [both.index(name) for name in config.later_names]
    for task, place in enumerate(places):
        actions = [(both.valid_actions_KA[index].tolist(), both.first_action(index)) for index in (task, place)]
        if actions[0] != actions[1]:
            raise TaskError(
                f"tasks.later_names makes {both.names[place]!r} of {names[task]!r}, expected a task with the same "
                "actions; choose another one, or pad the actions in an environment of your own"
            )
    earlier = replace(
        both,
        names=names,
        valid_actions_KA=both.valid_actions_KA[:count],
        references={name: one for name, one in both.references.items() if name in names},
        first_actions=both.first_actions[:count],
    )
    pictured = both.make_pictured
    later = replace(
        earlier,
        references={},  # published scores are of the earlier tasks
        make=lambda task, num_envs: both.make(places[task], num_envs),
        make_pictured=None if pictured is None else lambda task, num_envs: pictured(places[task], num_envs),
        versioned=False,  # kept random play is of the earlier tasks
    )
    changed = tuple(task for task, place in enumerate(places) if place != task)
    assert config.later_from_steps is not None
    return replace(earlier, later=Later(config.later_from_steps, later, changed))


def changed_conditions(config: TasksConfig, step: int) -> tuple[str, ...]:
    """Conditions of play after ``step`` agent steps of a run, in words: each task that is another one by then."""
    if config.later_from_steps is None or step < config.later_from_steps:
        return ()
    pairs = zip(config.names, config.later_names, strict=True)
    return tuple(f"{name} played as {later}" for name, later in pairs if name != later)
