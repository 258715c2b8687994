"""Refusals are counted one by one and logged now and then."""

from __future__ import annotations

from rs_localizer.ros.refusals import Refusals


def test_one_line_for_each_reason_and_period() -> None:
    lines: list[str] = []
    now = [100.0]
    refusals = Refusals(lines.append, clock=lambda: now[0])
    refusals.add("dark", "no light")
    refusals.add("dark", "still no light")
    refusals.add("late", "too late")
    assert lines == ["dark: no light", "late: too late"]
    now[0] += 4.9
    refusals.add("dark", "dark again")
    assert len(lines) == 2
    now[0] += 0.2
    refusals.add("dark", "dark for ever")
    assert lines[2:] == ["dark: dark for ever (2 more since the last report)"]
    now[0] += 5.1
    refusals.add("dark", "night")
    assert lines[3:] == ["dark: night"]
    assert refusals.counts == {"dark": 5, "late": 1}
