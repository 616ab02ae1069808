"""Saving and loading the state of the parts of a run.

A stateful part names what it saves in ``SAVED`` and what it can rebuild (settings, caches, things handed in) in
``DERIVED``; tests/learning/test_training.py walks all parts and fails if an attribute is in neither.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import torch

from switchmt_snn.errors import CheckpointError, ConfigError


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
            CheckpointError: an attribute was not saved.
        """
        missing = [name for name in self.SAVED if name not in state]
        if missing:
            raise CheckpointError(
                f"the checkpoint has no {', '.join(missing)} of {type(self).__name__}, expected what its SAVED names; "
                "if its code changed, restore it, or start a new run with --run"
            )
        for name in self.SAVED:
            setattr(self, name, _unpacked(getattr(self, name), state[name]))


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


def _unpacked(current: Any, saved: Any) -> Any:
    if isinstance(current, np.random.Generator):
        current.bit_generator.state = saved
        return current
    if isinstance(current, torch.Generator):
        current.set_state(saved)
        return current
    if hasattr(current, "load_state_dict"):
        current.load_state_dict(saved)
        return current
    if isinstance(current, torch.Tensor):  # stays on its device
        return current.copy_(saved)
    if isinstance(current, list) and current and hasattr(current[0], "load_state_dict"):
        for index, item in enumerate(current):
            item.load_state_dict(saved[str(index)])
        return current
    return saved
