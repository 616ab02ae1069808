"""Masked arrays of NumPy: as plain numbers they would show what their mask hides."""

from __future__ import annotations

from typing import Any

import numpy as np

FILL = "say what a masked value is worth: array.filled(0)"
"""What to do about masked values, for an error."""


def has_masked_values(observation: Any) -> bool:
    """Whether an observation is a masked array that hides a value."""
    return isinstance(observation, np.ma.MaskedArray) and bool(np.ma.is_masked(observation))
