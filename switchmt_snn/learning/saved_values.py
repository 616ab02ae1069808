"""What a saved state must be before a part takes it: like the state of a fresh part, and within its ranges.

A checkpoint may come from a stranger. What passes here does not fail later in the run.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from switchmt_snn.errors import CheckpointError, shown

if TYPE_CHECKING:
    from switchmt_snn.learning.training import Training

_LARGEST = 2**62
_LONGEST_TEXT = 1000


def require_like(current: Any, saved: Any, name: str) -> None:
    """Refuse a plain saved value of another kind than the present one: number, text, list, dict or array.

    An empty list may become one of any length; None may become any value.

    Raises:
        CheckpointError: naming the value.
    """
    if isinstance(current, (list, tuple)):
        fits = isinstance(saved, list) and (not current or len(saved) == len(current))
        if fits and current:
            for index, (now, item) in enumerate(zip(current, saved, strict=True)):
                require_like(now, item, f"number {index} of {name}")
        elif fits:
            _require_numbers(saved, name)
    elif isinstance(current, dict):
        fits = isinstance(saved, dict)
    elif isinstance(current, np.ndarray):
        fits = isinstance(saved, np.ndarray) and (saved.shape, saved.dtype.kind) == (current.shape, current.dtype.kind)
        fits = fits and bool(np.isfinite(saved).all())
    elif isinstance(current, bool):
        fits = isinstance(saved, bool)
    elif isinstance(current, int):
        fits = _whole(saved)
    elif isinstance(current, float):
        fits = _whole(saved) or (isinstance(saved, float) and math.isfinite(saved))
    elif isinstance(current, str):
        fits = isinstance(saved, str) and len(saved) <= _LONGEST_TEXT
    else:
        fits = current is None
    if not fits:
        raise _unlike(name, saved, f"a value like {shown(current)}")


def _require_numbers(saved: list[Any], name: str) -> None:
    """What a list may hold that is empty at first: finite numbers, truth values, lists of them, and tensors."""
    for item in saved:
        if isinstance(item, list):
            _require_numbers(item, name)
        elif isinstance(item, torch.Tensor):
            if not bool(torch.isfinite(item).all()):
                raise _unlike(name, item, "finite numbers")
        elif not isinstance(item, bool) and not _whole(item) and not (isinstance(item, float) and math.isfinite(item)):
            raise _unlike(name, item, "finite numbers")


def require_moments(optimizer: torch.optim.Optimizer, saved: Any, name: str) -> None:
    """Refuse the state of an optimizer of other parameters, with other settings, or with numbers that are not finite.

    Raises:
        CheckpointError: naming what differs.
    """
    (group,) = optimizer.param_groups
    groups = saved["param_groups"]
    if not isinstance(groups, list) or len(groups) != 1 or not isinstance(groups[0], dict):
        raise _unlike(f"param_groups of {name}", groups, "one group")
    for key in group.keys() & {"betas", "eps", "weight_decay", "amsgrad", "maximize", "differentiable"}:
        seen, expected = groups[0].get(key), group[key]
        if seen != (list(expected) if isinstance(expected, tuple) else expected) and seen != expected:
            raise _unlike(f"{key} of {name}", seen, shown(expected))
    for key in ("foreach", "fused", "capturable", "decoupled_weight_decay"):
        if not (groups[0].get(key) is None or isinstance(groups[0][key], bool)):
            raise _unlike(f"{key} of {name}", groups[0][key], "true, false or null")
    if "lr" in groups[0]:
        require_like(0.0, groups[0]["lr"], f"lr of {name}")
    numbers = list(range(len(group["params"])))
    if groups[0].get("params") != numbers or not set(saved["state"]) <= set(numbers):
        raise _unlike(f"params of {name}", groups[0].get("params"), f"{len(numbers)} parameters")
    for number, moments in saved["state"].items():
        expected = group["params"][number]
        if not isinstance(moments, dict) or set(moments) != {"step", "exp_avg", "exp_avg_sq"}:
            raise _unlike(f"number {number} of {name}", moments, "step, exp_avg and exp_avg_sq")
        for key, value in moments.items():
            shape = () if key == "step" else expected.shape
            fits = isinstance(value, torch.Tensor) and value.shape == shape and value.is_floating_point()
            if not fits or not bool(torch.isfinite(value).all()) or (key != "exp_avg" and bool((value < 0).any())):
                raise _unlike(
                    f"{key} of parameter {number} of {name}", value, f"finite numbers of shape {tuple(shape)}"
                )


def require_sound(training: Training, plays: Any) -> None:
    """Refuse a loaded run whose counts, actions or networks are out of their ranges.

    Args:
        training: loaded, but for its running episodes.
        plays: the state of those.

    Raises:
        CheckpointError: naming the first one.
    """
    _require_counts(training)
    valid_KA = training.suite.valid_actions_KA
    held, longest = training.exploration.left_KN, training.exploration.longest_K_steps
    if (held < 0).any() or (held > np.asarray(longest)[:, None]).any():
        raise _unlike("held random actions", held.tolist(), f"from 0 to {list(longest)} steps")
    for task, replay in enumerate(training.replays):
        held_N = training.exploration.actions_KN[task][held[task] > 0]
        _require_actions(held_N, valid_KA[task], "the held random actions")
        _require_actions(replay.actions_held(), valid_KA[task], "the replay memory")
    for part in (training.learner.network, training.learner.target):
        if not all(bool(torch.isfinite(tensor).all()) for tensor in part.state_dict().values()):
            raise _unlike("a network", "a number that is not finite", "finite weights")
    tasks = list(map(str, range(len(valid_KA))))
    if not isinstance(plays, dict) or not set(plays) <= set(tasks):
        raise _unlike("running episodes", plays, f"those of tasks {tasks}")
    if training.visit > 0 and str(training.task) not in plays:
        raise _unlike("running episodes", list(plays), f"those of the present task {training.task}")
    for task_name, play in plays.items():
        _require_episodes(play, valid_KA[int(task_name)])


def _require_counts(training: Training) -> None:
    counts = {
        name: np.ravel(getattr(training, name))
        for name in (
            "task", "visit", "steps", "steps_by_task", "steps_in_visit", "updates_in_visit", "episodes_in_visit",
            "episodes_by_task", "starts_by_task",
        )
    }  # fmt: skip
    counts["updates"] = np.ravel([training.learner.updates, training.learner.summed])
    most = dict.fromkeys(counts, _LARGEST) | {"task": len(training.suite.names)}
    for name in ("update_clock", "target_clock", "metrics_clock"):
        clock = getattr(training, name)
        counts[name], most[name] = np.ravel(clock.waited_steps), clock.period_steps
    for name, values in counts.items():
        if (values < 0).any() or (values >= most[name]).any():
            raise _unlike(f"{name} of the run", values.tolist(), f"from 0 to below {most[name]:,}")


def _require_episodes(play: Any, valid_A: Any) -> None:
    seeds, actions = (play.get("seeds"), play.get("actions")) if isinstance(play, dict) else (None, None)
    if not isinstance(seeds, np.ndarray) or seeds.dtype.kind != "i" or seeds.ndim != 1 or (seeds < 0).any():
        raise _unlike("seeds of running episodes", seeds, "whole numbers from 0")
    for journal in actions if isinstance(actions, list) else [None]:
        if not isinstance(journal, np.ndarray) or journal.dtype.kind != "i" or journal.ndim != 1:
            raise _unlike("actions of running episodes", journal, "lists of whole numbers")
        _require_actions(journal, valid_A, "the running episodes")


def _require_actions(actions: Any, valid_A: Any, what: str) -> None:
    strange = actions[~np.isin(actions, np.flatnonzero(valid_A))]
    if len(strange):
        raise _unlike(f"an action of {what}", int(strange[0]), f"one of {np.flatnonzero(valid_A).tolist()}")


def _whole(value: Any) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and -_LARGEST < value < _LARGEST


def _unlike(name: str, seen: Any, expected: str) -> CheckpointError:
    return CheckpointError(
        f"the checkpoint has {shown(seen)} as {name}, expected {expected}; if code or config changed, restore it, or "
        "start a new run with --run"
    )
