# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of a clock: what is one, and what only looks like one."""

import pytest

from rs_localizer.pipeline.clock_jumps import ClockJumps

SECOND = 10**9


def jumps(times: list[float]) -> list[float]:
    """The times at which the clock has jumped."""
    clock, found, before = ClockJumps(), [], 0
    for time in times:
        now = round(time * SECOND)
        if clock.is_jump(before, now - before):
            found.append(time)
        before = now
    return found


@pytest.mark.parametrize(
    ("times", "expected"),
    [
        ([1e9 + 0.01 * k for k in range(99)], []),  # the first one sets it
        ([3.0 + 0.01 * k for k in range(99)] + [50.0, 50.01], [50.0]),
        ([3.0 + 0.01 * k for k in range(99)] + [8.9, 8.91], []),
        ([3.0 + 0.01 * k for k in range(99)] + [2.0, 2.01], [2.0]),
        ([10.0 * k for k in range(1, 99)], []),  # a clock of 1 Hz that is played tenfold
        ([10.0 * k for k in range(1, 99)] + [1200.0], [1200.0]),
        ([0.01 * k for k in range(9)], []),  # a simulation that begins at zero
    ],
)
def test_jumps_are_told_from_steps(times, expected):
    assert jumps(times) == expected
