"""Rates between the samples of a gyroscope.

A gyroscope filters what it shows below half its sample rate, so its samples tell the rates between
them; but a cubic spline through the samples loses 4 % of a vibration at 0.3 of the sample rate (3
deg/s of 0.1 deg at 120 Hz and 400 Hz). The best guess of a process whose spectrum is flat up to a
limit (a Gaussian process with a cardinal sine as covariance; Wiener, 1949) loses 0.15 %, with four
samples on each side. It is taken half way between the samples; for what lies between those, cubics
are good enough.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import kernel

# End of the spectrum, as a part of the sample rate, and noise beside it (variance).
_BAND, _NOISE = 0.4, 1e-5
# More samples than this in an exposure are dense enough, and solving for them would take time.
_MOST = 64


@kernel
def densified(times: Array, rates: Array) -> tuple[Array, Array]:
    """Times (2 n - 1,) and rates (2 n - 1,3): those given, and one between each two of them.

    Args:
        times: (n,) increasing, s; they need not be regular.
        rates: (n,3) at these times.
    """
    count = len(times)
    if not 3 < count <= _MOST:
        return times, rates
    steps = np.empty(count - 1)
    for i in range(count - 1):
        steps[i] = times[i + 1] - times[i]
    width = 2.0 * np.pi * _BAND / np.median(steps)
    # The sine of a difference by those of both: n of them, not n^2.
    sines, cosines = np.sin(width * times), np.cos(width * times)
    factor = np.empty((count, count))
    # Nothing is supposed of the mean.
    mean = np.zeros(3)
    for i in range(count):
        for axis in range(3):
            mean[axis] += rates[i, axis] / count
    solved = rates - mean
    for i in range(count):  # Cholesky, and the first substitution beside it
        for j in range(i + 1):
            sine = sines[i] * cosines[j] - cosines[i] * sines[j]
            total = 1.0 + _NOISE if i == j else sine / (width * (times[i] - times[j]))
            for k in range(j):
                total -= factor[i, k] * factor[j, k]
            factor[i, j] = np.sqrt(max(total, _NOISE * _NOISE)) if i == j else total / factor[j, j]
        for axis in range(3):
            left = solved[i, axis]
            for k in range(i):
                left -= factor[i, k] * solved[k, axis]
            solved[i, axis] = left / factor[i, i]
    for i in range(count - 1, -1, -1):
        for axis in range(3):
            left = solved[i, axis]
            for k in range(i + 1, count):
                left -= factor[k, i] * solved[k, axis]
            solved[i, axis] = left / factor[i, i]
    dense, found = np.empty(2 * count - 1), np.zeros((2 * count - 1, 3))
    for i in range(count):
        dense[2 * i] = times[i]
        write(found[2 * i], rates[i])
        if i + 1 < count:
            between = 0.5 * (times[i] + times[i + 1])
            write(found[2 * i + 1], mean)
            dense[2 * i + 1] = between
            here, aside = np.sin(width * between), np.cos(width * between)
            for k in range(count):
                sine = here * cosines[k] - aside * sines[k]
                weight = sine / (width * (between - times[k]))
                for axis in range(3):
                    found[2 * i + 1, axis] += weight * solved[k, axis]
    return dense, found
