"""Whether what a suite states has the type and range that its readers need: its own facts, and those of its tasks."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import numpy as np

from switchmt_snn.config import TasksConfig, resolved_frame_stack
from switchmt_snn.config.plugins import user_code
from switchmt_snn.errors import TaskError, shown
from switchmt_snn.tasks.suite import PublishedScores, Reference, Suite, TaskSuite


def is_outside(suite: type[Suite]) -> bool:
    """Whether a suite's class is from outside the package."""
    return not suite.__module__.startswith("switchmt_snn.")


def suite_code(suite: type[Suite], name: str, where: str) -> AbstractContextManager[None]:
    """Around a call of the suite that a config names; see ``user_code``."""
    return user_code(f"the suite {name!r} fails in {where}", "no error; mend it", TaskError, is_outside(suite))


def require_facts(suite: Suite, config: TasksConfig) -> None:
    """Refuse facts of a suite from outside the package that would fail when they are shown or stored.

    Args:
        suite: of the config.
        config: names the suite and the tasks.

    Raises:
        TaskError: naming the fact, what was seen, and what was expected.
    """
    names = config.names
    for fact, holds, expected in (
        *_FACTS,
        ("tasks_with_lives", lambda lives: _texts(lives) and set(lives) <= set(names), f"a tuple of names in {names}"),
    ):
        with suite_code(type(suite), config.suite, fact):
            value = getattr(suite, fact)
        if not holds(value):
            raise TaskError(f"the suite {config.suite!r} states {fact} = {shown(value)}, expected {expected}")


def require_tasks(tasks: Any, config: TasksConfig) -> TaskSuite:
    """Return what a suite's ``make`` returned if it is what its readers need.

    Raises:
        TaskError: naming the field, what was seen, and what was expected.
    """
    if not isinstance(tasks, TaskSuite):
        raise TaskError(
            f"the suite {config.suite!r} gave {shown(tasks)} from make, expected a TaskSuite; change its make()"
        )
    count, stack = len(config.names), resolved_frame_stack(config)
    fields: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
        ("names", _writable, "printable names without commas and quotes, which tables could not hold"),
        ("names", lambda names: names == config.names, f"those of the config, {config.names}"),
        ("frame_stack", lambda value: value == stack, f"{stack}"),
        ("frame_shape", _is_shape, "(features,) or (channels, H, W)"),
        ("frame_dtype", _is_frame_dtype, "uint8 or float32"),
        ("scale", lambda scale: _number(scale) and scale > 0, "a number above 0"),
        ("in_unit_range", _truth, "True or False"),
        ("action_names", lambda names: _texts(names) and len(names) > 0, "a tuple of texts, one for each action"),
        (
            "valid_actions_KA",
            lambda valid: _is_mask(valid, (count, len(tasks.action_names))),
            "an array of truth values (np.bool_), a row per task, a column per action, and one or more true in a row",
        ),
        ("references", _are_references, _REFERENCES),
        (
            "first_actions",
            lambda first: isinstance(first, tuple) and len(first) in (0, count) and all(map(_whole, first)),
            f"none, or one whole number for each of {count} tasks",
        ),
        ("thread_safe", _truth, "True or False"),
        ("versioned", _truth, "True or False"),
        ("make", callable, "a function make(task, num_envs) -> the copies of a task"),
        ("make_pictured", lambda make: make is None or callable(make), "None, or a function as make"),
    )
    for name, holds, expected in fields:
        value = getattr(tasks, name)
        if not holds(value):
            raise TaskError(
                f"the suite {config.suite!r} makes tasks of {name} {shown(value)}, expected {expected}; change "
                "its make()"
            )
    return tasks


def _truth(value: Any) -> bool:
    return isinstance(value, (bool, np.bool_))


def _whole(value: Any) -> bool:
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def _number(value: Any) -> bool:
    return (_whole(value) or isinstance(value, (float, np.floating))) and math.isfinite(value)


def _texts(value: Any) -> bool:
    return isinstance(value, tuple) and all(isinstance(text, str) for text in value)


def _writable(names: Any) -> bool:
    return _texts(names) and all(name and name.isprintable() and not set(name) & set(',"') for name in names)


def _is_shape(shape: Any) -> bool:
    return isinstance(shape, tuple) and len(shape) in (1, 3) and all(_whole(size) and size > 0 for size in shape)


def _is_frame_dtype(dtype: Any) -> bool:
    try:
        return np.dtype(dtype) in (np.uint8, np.float32)
    except TypeError:
        return False


def _is_mask(valid: Any, shape: tuple[int, int]) -> bool:
    is_mask = isinstance(valid, np.ndarray) and valid.dtype == np.bool_ and valid.shape == shape
    return is_mask and bool(valid.any(axis=1).all())


def _are_references(references: Any) -> bool:
    return isinstance(references, dict) and all(
        isinstance(task, str)
        and isinstance(reference, Reference)
        and _number(reference.random)
        and _number(reference.human)
        and reference.human != reference.random
        for task, reference in references.items()
    )


def _are_published(published: Any) -> bool:
    return isinstance(published, tuple) and all(
        isinstance(row, PublishedScores) and isinstance(row.scores, dict) and all(map(_number, row.scores.values()))
        for row in published
    )


def _are_words(words: Any) -> bool:
    return isinstance(words, dict) and all(isinstance(text, str) for pair in words.items() for text in pair)


def _are_files(files: Any) -> bool:
    return isinstance(files, dict) and all(isinstance(path, Path) and path.is_file() for path in files.values())


_REFERENCES = "Reference(random, human, source) by task, with two numbers that differ"
_FACTS: tuple[tuple[str, Callable[[Any], bool], str], ...] = (
    ("open_names", _truth, "True or False"),
    ("masks_actions", _truth, "True or False"),
    ("takes_wrappers", _truth, "True or False"),
    ("packages", _texts, 'a tuple of names, as ("my-package",) with its comma'),
    ("protocol", _texts, 'a tuple of texts, as ("sticky actions 0.25",) with its comma'),
    ("references", _are_references, _REFERENCES),
    ("published", _are_published, "a tuple of PublishedScores(policy, source, scores), with a number for each task"),
    ("frame_skip", lambda skip: _whole(skip) and skip > 0, "a whole number above 0"),
    ("frames_per_s", lambda rate: rate is None or (_number(rate) and rate > 0), "a number above 0, or None"),
    ("steps_to_learn", lambda steps: steps is None or (_whole(steps) and steps > 0), "a whole number above 0, or None"),
    ("process_bytes", lambda count: _whole(count) and count >= 0, "a whole number of at least 0"),
    ("registered", _are_words, "a text for each name, as {'levels.txt': its checksum}"),
    ("files", _are_files, "a pathlib.Path of a file that exists, by its name"),
)
"""What a suite states: the attribute, whether a value will do, and what will."""
