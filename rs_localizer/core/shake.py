# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The in-frame rotation: how a camera vibrates while it moves with constant acceleration.

The rotation vector (rad) is a sum of cosines and sines of the row time ``tau`` (-0.5 to 0.5). Their
frequencies are fixed, half a cycle per readout apart. With Gaussian coefficients the sum is a
Gaussian process in row time, which can have any spectrum. Each function has its value and its slope
at ``tau`` = 0 subtracted, so that pose and velocities of the middle row belong to the motion alone.
"""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array, Array1, Array2, Out
from rs_localizer.native import entry

CYCLES = 0.5 * np.arange(1.0, 15.0)
"""Cycles per readout: up to 233 Hz with a readout of 30 ms. A window of one readout resolves
frequencies that are half a cycle apart."""
FUNCTIONS = 2 * len(CYCLES)
RATES = 2.0 * np.pi * CYCLES
"""rad per unit of row time."""
# :func:`shake_basis` subtracts the value and the rate of each function at the middle row.
MIDDLE_VALUES, MIDDLE_RATES = np.zeros(FUNCTIONS), np.zeros(FUNCTIONS)
MIDDLE_VALUES[::2], MIDDLE_RATES[1::2] = 1.0, RATES
TYPICAL_SIZES = 3e-4 / np.sqrt(CYCLES)
"""rad, amplitudes of an ordinary vibration: 0.02 deg at one cycle per readout, less if faster."""
RESOLVED = 18
"""Combinations of cosines and sines that one readout tells from each other. The squares of all
others are below 1e-4 of the largest, and they rotate the middle row as little."""


def _resolved() -> tuple[Array, Array]:
    """Return combinations (28,18) of the functions, and the functions as their sums (18,28).

    The combinations of an ordinary vibration are independent, and of size 1. They turn the last row
    forward: without that, each version of LAPACK has other signs, and kernels that were built with
    another one would not fit.
    """
    tau, sizes = np.linspace(-0.5, 0.5, 401)[:, None], np.repeat(TYPICAL_SIZES, 2)
    shown = np.empty((len(tau), FUNCTIONS))
    shown[:, ::2] = np.cos(RATES * tau) * sizes[::2]
    shown[:, 1::2] = np.sin(RATES * tau) * sizes[1::2]
    _, _, parts = np.linalg.svd(shown, full_matrices=False)
    parts = parts[:RESOLVED] * np.sign(parts[:RESOLVED] @ shown[-1])[:, None]
    return np.ascontiguousarray(sizes[:, None] * parts.T), parts / sizes


COMBINATIONS, IN_COMBINATIONS = _resolved()


def shake_functions(tau: Array) -> tuple[Array, Array]:
    """Return :func:`shake_basis` at row times (n,) without kernels: values and rates (n,28)."""
    angle = np.asarray(tau)[:, None] * RATES
    values = np.stack([np.cos(angle) - 1.0, np.sin(angle) - angle], axis=2)
    rates = RATES[:, None] * np.stack([-np.sin(angle), np.cos(angle) - 1.0], axis=2)
    return values.reshape(-1, FUNCTIONS), rates.reshape(-1, FUNCTIONS)


@entry
def shake_basis(tau: float, values: Out[Array1], rates: Out[Array1]) -> None:
    """Fill in ``cos(w tau) - 1`` and ``sin(w tau) - w tau`` of each frequency, and their rates.

    By the recurrence of the half-cycle: frequencies are its multiples.
    """
    step = RATES[0] * tau
    cosine, sine = np.cos(step), np.sin(step)
    c, s = 1.0, 0.0
    for k in range(len(RATES)):
        c, s = c * cosine - s * sine, s * cosine + c * sine
        values[2 * k], values[2 * k + 1] = c - 1.0, s - RATES[k] * tau
        rates[2 * k], rates[2 * k + 1] = -RATES[k] * s, RATES[k] * (c - 1.0)


@entry
def shake_at(tau: Array1, coefficients: Array2) -> Array:
    """Return in-frame rotations (rad) and their rates, (n,6), at row times (n,).

    ``coefficients`` (k,3) rad, of :func:`shake_basis`; none: the camera does not shake.
    """
    count = len(coefficients)
    values, rates = np.empty(FUNCTIONS), np.empty(FUNCTIONS)
    shake = np.zeros((len(tau), 6))
    if count == 0:
        return shake
    for i in range(len(tau)):
        shake_basis(tau[i], values, rates)
        for k in range(count):
            for axis in range(3):
                shake[i, axis] += values[k] * coefficients[k, axis]
                shake[i, 3 + axis] += rates[k] * coefficients[k, axis]
    return shake


def within_rows(tau: float) -> float:
    """Return a row time limited to the first and the last row."""
    return min(max(tau, -0.5), 0.5)
