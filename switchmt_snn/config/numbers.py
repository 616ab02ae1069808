"""Numbers as text that reads back as the same number, and text that a user means as a number."""

from __future__ import annotations

import contextlib

_EXACT_INTEGERS = 2.0**53


def exact(value: float) -> str:
    """The shortest text that reads back as this float; a whole number without its ``.0``.

    Examples:
        >>> exact(1234567.0), exact(0.1), exact(-0.5)
        ('1234567', '0.1', '-0.5')
    """
    value = float(value)
    return str(int(value)) if value.is_integer() and abs(value) < _EXACT_INTEGERS else repr(value)


def whole_number(text: str) -> int:
    """A whole number as people write it: ``1000000``, ``1_000_000``, ``1e6``.

    Raises:
        ValueError: the text is no number, or not a whole one.

    Examples:
        >>> whole_number("1e6"), whole_number("12_000")
        (1000000, 12000)
    """
    try:
        return int(text)
    except ValueError:
        pass
    with contextlib.suppress(ValueError):
        if (number := float(text)).is_integer():
            return int(number)
    raise ValueError(f"{text!r} is not a whole number such as 1000000 or 1e6")
