"""Time left: right from the first minutes on, whatever the start was like, and not wrapped at a day."""

from __future__ import annotations

import pytest

from switchmt_snn.drawing.numbers import duration
from switchmt_snn.viewing.progress import Speed


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (-3.0, "00:00:00"),
        (59.9, "00:00:59"),
        (81_935.0, "22:45:35"),
        (86_400.0, "1 d 00:00:00"),
        (119 * 3600.0 + 1, "4 d 23:00:01"),
    ],
)
def test_a_duration_of_days_has_days(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_speed_forgets_a_start_that_was_fast() -> None:
    """A replay that fills makes 1,000 steps a second for a minute, training then makes 10."""
    speed, steps = Speed(0.0, 0), 0
    for second in range(1, 301):
        steps += 1_000 if second <= 60 else 10
        rate = speed.per_second(float(second), steps)
        if second >= 122:
            assert rate == pytest.approx(10)
    assert steps / 300 > 200, "an average since the start would be wrong by far"


def test_speed_remembers_ten_minutes_at_most() -> None:
    speed, steps = Speed(0.0, 0), 0
    for minute in range(1, 601):
        steps += 60 if minute <= 590 else 600
        rate = speed.per_second(60.0 * minute, steps)
    assert rate == pytest.approx(10)


def test_without_time_there_is_no_speed() -> None:
    assert Speed(5.0, 100).per_second(5.0, 100) == 0.0
