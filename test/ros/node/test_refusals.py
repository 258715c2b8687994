# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Refusals are counted one by one and logged now and then."""

import pytest

from rs_localizer.ros.node.refusals import Refusals


class Log:
    """Refusals with a clock that stands still, and the lines that they gave."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.now = 100.0
        self.refusals = Refusals(self.lines.append, clock=lambda: self.now)
        self.add = self.refusals.add


@pytest.fixture
def log() -> Log:
    return Log()


def test_one_line_for_each_reason_and_period(log):
    log.add("dark", "no light")
    log.add("dark", "no light")
    log.add("late", "too late")
    assert log.lines == ["dark: no light", "late: too late"]
    log.now += 4.9
    log.add("dark", "no light")
    assert len(log.lines) == 2
    log.now += 0.2
    log.add("dark", "no light")
    assert log.lines[2:] == ["dark: no light (2 more since the last report)"]
    log.now += 5.1
    log.add("dark", "no light")
    assert log.lines[3:] == ["dark: no light"]
    assert log.refusals.counts == {"dark": 5, "late": 1}


def test_details_that_differ_in_numbers_are_one(log):
    for inliers in range(8, 12):
        log.add("too_few_inliers", f"{inliers} of 100 points within 2.0 px")
    log.now += 6.0
    log.add("too_few_inliers", "7 of 90 points within 2.0 px")
    assert log.lines == [
        "too_few_inliers: 8 of 100 points within 2.0 px",
        "too_few_inliers: 7 of 90 points within 2.0 px (3 more since the last report)",
    ]


def test_ever_new_details_fill_neither_log_nor_memory(log):
    letters = "abcdefghijklmnopqrstuvwxyz"
    for second in range(60):
        for first in letters:
            log.add("odd", f"field {first}{letters[second % 26]}{letters[second // 26]}")
        log.now += 1.0
    assert 12 <= len(log.lines) <= 12 * 9
    assert sum(map(len, log.refusals._logged.values())) <= 9
    assert log.refusals.counts == {"odd": 60 * 26}
