"""The gyroscope's part of the normal equations, compiled.

In the gyroscope's axes ``e = M rate(t + delay) + bias - measured``: the noise of the samples must
not stand beside what is estimated of ``M``, which it would make smaller.
"""

from __future__ import annotations

from typing import NamedTuple

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.simd.jit import kernel
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL

MOUNT = 13
"""Numbers of a mount: turn of the IMU in its own axes, bias, delay, shape."""
DELAY = 6
"""Place of the delay among them."""


class Turns(NamedTuple):
    """Samples on the spline."""

    first: IntArray  # (k,) first of the four controls
    errors: Array  # (k,3) rad/s, in the gyroscope's axes
    by_controls: Array  # (k,3,24)
    by_mount: Array  # (k,3,13)


@kernel
def accumulate_turns(turns: Turns, column: int, variance: float, limit: float,
                     normal: Normal) -> float:  # fmt: skip
    """Add the samples to the normal equations; returns their cost.

    Args:
        column: of the border, where the mount begins.
        variance: (rad/s)^2, of the noise of an axis.
        limit: (rad/s)^2, where Tukey's weight ends.
    """
    cost = 0.0
    for n in range(len(turns.first)):
        error, rows, border = turns.errors[n], turns.by_controls[n], turns.by_mount[n]
        squared = error[0] * error[0] + error[1] * error[1] + error[2] * error[2]
        rest = 1.0 - squared / limit
        if not rest > 0.0:
            cost += limit / (3.0 * variance)
            continue
        cost += (1.0 - rest * rest * rest) * limit / (3.0 * variance)
        weight = rest * rest / variance
        base = CONTROL * turns.first[n]
        for a in range(LOCAL):
            if a % CONTROL >= 3:
                continue  # the rate does not depend on positions
            x, y, z = weight * rows[0, a], weight * rows[1, a], weight * rows[2, a]
            normal.slope[base + a] += x * error[0] + y * error[1] + z * error[2]
            for b in range(a + 1):
                if b % CONTROL < 3:
                    normal.band[a - b, base + b] += x * rows[0, b] + y * rows[1, b] + z * rows[2, b]
            for k in range(MOUNT):
                normal.cross[base + a, column + k] += (
                    x * border[0, k] + y * border[1, k] + z * border[2, k]
                )
        for k in range(MOUNT):
            x, y, z = weight * border[0, k], weight * border[1, k], weight * border[2, k]
            normal.border_slope[column + k] += x * error[0] + y * error[1] + z * error[2]
            for j in range(k + 1):
                normal.corner[column + k, column + j] += (
                    x * border[0, j] + y * border[1, j] + z * border[2, j]
                )
    return cost
