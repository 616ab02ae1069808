"""Saving and loading the state of the parts of a run.

A stateful part names what it saves in ``SAVED`` and what it can rebuild (settings, caches, things handed in) in
``DERIVED``; tests/learning/test_training.py walks all parts and fails if an attribute is in neither.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import numpy as np
import torch

from switchmt_snn.errors import CheckpointError, ConfigError, reason_of, require_saved
from switchmt_snn.learning.saved_values import require_like, require_moments


class Stateful:
    """A part whose ``SAVED`` attributes make up its state.

    An attribute may be a number, text, list or dict of such, an array or tensor, a random generator, or another part
    with ``state_dict`` and ``load_state_dict``.
    """

    SAVED: ClassVar[tuple[str, ...]] = ()
    DERIVED: ClassVar[tuple[str, ...]] = ()

    def state_dict(self) -> dict[str, Any]:
        """The saved attributes, as nested dicts of plain values, arrays and tensors."""
        return {name: _packed(getattr(self, name)) for name in self.SAVED}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Put a saved state back; parts and generators are filled in place.

        Raises:
            CheckpointError: an attribute was not saved, or what was saved does not fit it.
        """
        owner = type(self).__name__
        require_saved(state, self.SAVED, owner)
        ours = type(self).__module__.startswith("switchmt_snn.")  # parts from outside may save any kind of value
        for name in self.SAVED:
            present, described = getattr(self, name), f"{name} of {owner}"
            if ours and not isinstance(present, torch.Tensor) and not _is_part(present):
                require_like(present, state[name], described)
            setattr(self, name, _unpacked(present, state[name], described))


def require_storable(value: Any, name: str) -> None:
    """Refuse a part of a state that would not come back from a checkpoint as it was.

    Args:
        value: from ``Stateful.state_dict``.
        name: what it is, for the error.

    Raises:
        ConfigError: naming the value's place and type.
    """
    if isinstance(value, dict):
        for key, item in value.items():
            if not isinstance(key, str):
                raise ConfigError(
                    f"{name} has the key {key!r}, expected keys that are texts; a checkpoint gives texts back"
                )
            require_storable(item, f"{name}[{key!r}]")
    elif isinstance(value, (list, tuple)):
        for index, item in enumerate(value):
            require_storable(item, f"{name}[{index}]")
    elif not (value is None or isinstance(value, (bool, int, float, str, np.ndarray, torch.Tensor))):
        raise ConfigError(
            f"{name} is a {type(value).__name__}, expected what a checkpoint can hold: a number, a text, a list or "
            "dict of such, an array, a tensor or a random generator; an int(...) or float(...) of a NumPy number is one"
        )


def _packed(value: Any) -> Any:
    if isinstance(value, np.random.Generator):
        return value.bit_generator.state
    if isinstance(value, torch.Generator):
        return value.get_state()
    if hasattr(value, "state_dict"):
        return value.state_dict()
    if isinstance(value, list) and value and hasattr(value[0], "state_dict"):
        return {str(index): item.state_dict() for index, item in enumerate(value)}
    return value.copy() if isinstance(value, (list, dict, np.ndarray)) else value


def _is_part(value: Any) -> bool:
    """Whether a value takes its state itself."""
    if isinstance(value, list) and value:
        return isinstance(value[0], torch.Tensor) or hasattr(value[0], "load_state_dict")
    return isinstance(value, (np.random.Generator, torch.Generator)) or hasattr(value, "load_state_dict")


def _unpacked(current: Any, saved: Any, name: str) -> Any:
    if isinstance(current, np.random.Generator):
        with _fitting(name, "the state of such a random generator"):
            current.bit_generator.state = saved
        return current
    if isinstance(current, torch.Generator):
        with _fitting(name, "the state of such a random generator"):
            current.set_state(saved)
        return current
    if isinstance(current, torch.optim.Optimizer):
        with _fitting(name, "the state of an optimizer of the same parameters"):
            require_moments(current, saved, name)
            current.load_state_dict(saved)
        return current
    if hasattr(current, "load_state_dict"):
        if isinstance(current, torch.nn.Module) and not isinstance(saved, dict):
            raise _unfitting(name, _kind(saved), "a dict of its parameters")
        current.load_state_dict(saved)
        return current
    if isinstance(current, torch.Tensor):  # stays on its device
        return current.copy_(_tensor_like(current, saved, name))
    if isinstance(current, list) and current and hasattr(current[0], "load_state_dict"):
        require_saved(saved, map(str, range(len(current))), name)
        for index, item in enumerate(current):
            item.load_state_dict(saved[str(index)])
        return current
    return saved


def tensors_like(current: list[torch.Tensor], saved: Any, name: str) -> list[torch.Tensor]:
    """Saved tensors on the devices of the present ones.

    Args:
        current: the present tensors.
        saved: from a checkpoint.
        name: what they are, for the error.

    Raises:
        CheckpointError: not as many tensors, or one of another shape.
    """
    if not isinstance(saved, list) or len(saved) != len(current):
        raise _unfitting(name, _kind(saved), f"a list of {len(current)} tensors")
    return [
        _tensor_like(now, tensor, f"number {index} of {name}").to(now.device)
        for index, (now, tensor) in enumerate(zip(current, saved, strict=True))
    ]


def _tensor_like(current: torch.Tensor, saved: Any, name: str) -> torch.Tensor:
    if not isinstance(saved, torch.Tensor) or saved.shape != current.shape or saved.is_complex():
        raise _unfitting(name, _kind(saved), _kind(current))
    return saved


def _kind(value: Any) -> str:
    if isinstance(value, (torch.Tensor, np.ndarray)):
        return f"a {type(value).__name__} of shape {tuple(value.shape)}"
    return f"a list of {len(value)}" if isinstance(value, list) else f"a {type(value).__name__}"


def _unfitting(name: str, seen: str, expected: str) -> CheckpointError:
    return CheckpointError(
        f"the checkpoint has {seen} as {name}, expected {expected}; if code or config changed, restore it, or start a "
        "new run with --run"
    )


@contextmanager
def _fitting(name: str, expected: str) -> Iterator[None]:
    """Around PyTorch's and NumPy's own loading: what they raise about a state that does not fit becomes one line."""
    try:
        yield
    except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError, RuntimeError) as error:
        reason = f"{type(error).__name__}: {reason_of(error)}"
        raise _unfitting(name, f"a state that does not fit ({reason:.300})", expected) from error
