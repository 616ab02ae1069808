"""Numbers as pages show them."""

from __future__ import annotations

import math


def whole(value: float) -> str:
    """A count."""
    return f"{value:,.0f}"


def digits(value: float) -> str:
    """Three significant digits, without an exponent from 0.001 on."""
    if value == 0:
        return "0"
    if abs(value) >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}" if abs(value) >= 1e-3 else f"{value:.1e}"


def percent(value: float) -> str:
    """A share."""
    return f"{value:.2%}" if value < 1 else "100%"


def two(value: float) -> str:
    """A ratio."""
    return f"{value:.2f}"


def compact(value: float) -> str:
    """A number at an axis: thousands as k, millions as M.

    Examples:
        >>> compact(1_500_000.0), compact(20_000.0), compact(-0.25), compact(950.0)
        ('1.5M', '20k', '-0.25', '950')
    """
    for unit, letter in ((1e9, "G"), (1e6, "M"), (1e3, "k")):
        if abs(value) >= unit * (10 if letter == "k" else 1):
            return f"{value / unit:.4g}{letter}"
    return f"{value:,.4g}" if abs(value) < 1e3 else f"{value:,.0f}"


def scaled(value: float, unit: str) -> str:
    """Three significant digits in the unit that fits, from pico to the unit itself.

    Examples:
        >>> scaled(0.00783, "J"), scaled(1.47e-6, "J"), scaled(15.6, "J")
        ('7.83 mJ', '1.47 µJ', '15.6 J')
    """
    prefixes = (("", 1.0), ("m", 1e-3), ("µ", 1e-6), ("n", 1e-9), ("p", 1e-12))
    prefix, factor = next((one for one in prefixes if abs(value) >= 0.9995 * one[1]), prefixes[-1])
    return f"{digits(value / factor)} {prefix}{unit}"


def bytes_of(value: float) -> str:
    """Bytes in the unit that fits.

    Examples:
        >>> bytes_of(512), bytes_of(3_500_000)
        ('512 B', '3.3 MiB')
    """
    size, units = float(value), ["B", "KiB", "MiB", "GiB", "TiB"]
    while size >= 1024 and len(units) > 1:
        size /= 1024
        units.pop(0)
    return f"{size:,.0f} {units[0]}" if units[0] == "B" or size >= 100 else f"{size:.1f} {units[0]}"


def duration(seconds: float) -> str:
    """Hours, minutes and seconds; days in front if there are any.

    Examples:
        >>> duration(3_725.4), duration(428_400)
        ('01:02:05', '4 d 23:00:00')
    """
    days, rest = divmod(max(0, int(seconds)), 86_400)
    clock = f"{rest // 3600:02}:{rest // 60 % 60:02}:{rest % 60:02}"
    return f"{days} d {clock}" if days else clock


def is_number(value: float | None) -> bool:
    """Whether there is a finite number."""
    return value is not None and math.isfinite(value)
