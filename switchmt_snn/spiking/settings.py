"""The check of a setting at the place that branches on it: a value that no branch names is an error there."""

from __future__ import annotations

from collections.abc import Iterable

from switchmt_snn.config.checks import require
from switchmt_snn.errors import nearest


def require_known(key: str, seen: str, known: Iterable[str], remedy: str = "") -> None:
    """Refuse a value that is none of the known ones.

    Args:
        key: the setting's name in a config, as ``readout``.
        seen: its value.
        known: the values that the caller has code for.
        remedy: what to do about it, if there is more to say than the known values.

    Raises:
        ConfigError: naming the key, the value and the known values.
    """
    names = list(known)
    expected = " or ".join(names) + nearest(str(seen), names)
    require(seen in names, f"network.{key}", seen, expected, remedy)
