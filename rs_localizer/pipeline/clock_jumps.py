# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps of a clock, told from the steps of a simulated one."""

from collections import deque

# A step of a simulation or a recording that is played is none, however fast it is played: s, and
# periods of the clock.
_LEAST, _PERIODS = 5.0, 20.0
_REMEMBERED = 9  # steps, of which the median is the period


class ClockJumps:
    """Tells jumps from steps."""

    def __init__(self) -> None:
        self._steps: deque[int] = deque(maxlen=_REMEMBERED)

    def is_jump(self, before_ns: int, step_ns: int) -> bool:
        """Return True if a step of the clock makes all earlier knowledge useless.

        Args:
            before_ns: the clock before this step; 0: it has not been set.
            step_ns: by how much it has changed.
        """
        if before_ns == 0:
            return False
        if step_ns < 0:
            self._steps.clear()
            return True
        steps = sorted(self._steps)
        period = steps[len(steps) // 2] if steps else step_ns
        jump = step_ns > max(1e9 * _LEAST, _PERIODS * period)
        if not jump:
            self._steps.append(step_ns)
        return jump
