"""Which tones may shake a camera: the marginal likelihood of each frequency.

A periodogram by least squares (Lomb, "Least-squares frequency analysis of unequally spaced data",
1976) of the errors that a motion leaves: beside each tone the motion is fitted anew, and the swings
about all axes are Gaussian coefficients of unknown size (Bretthorst, "Bayesian spectrum analysis
and parameter estimation", 1988).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.blocks import write
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.state import ANGULAR
from rs_localizer.core.tones import MOST_CYCLES
from rs_localizer.estimation.columns import Columns
from rs_localizer.estimation.evidence import evidence_of_sizes, project_out
from rs_localizer.estimation.refine import LEAST_NOISE, inverted

# What is slower, polynomials of low degree follow. A readout tells tones apart that differ by one.
CYCLES = np.arange(1.0, MOST_CYCLES + 0.1, 0.25)
"""Frequencies that are tried, in cycles per readout."""
SWINGS = np.radians([1e-6, 0.01, 0.03, 0.1, 0.3, 1.0])
"""Sizes that are tried, rad; the first is none."""
_TONE = 6  # coefficients: of cosine and sine, about three axes
# Rows of such a part of the readout are taken together: the fastest tone turns by 30 degrees in it.
_BINS = 96
_ANGLES = 2.0 * math.pi * np.outer(CYCLES, (np.arange(_BINS) + 0.5) / _BINS - 0.5)
_WAVES = np.stack([np.cos(_ANGLES), np.sin(_ANGLES)])
_LITTLE = 1e-300
_HARDLY = 1e-3  # of the probability, which may be left out
_RATE = ANGULAR.start  # where angular velocities are among the parameters; turns are the first


@kernel
def _bin(tau: float) -> int:
    return min(max(int((tau + 0.5) * _BINS), 0), _BINS - 1)


class Powers(NamedTuple):
    """What a first look hears of tones."""

    loudest: float  # power of the loudest tone: of each, without one, chi-squared of six
    # (m,s-1) logarithm of the likelihood of each frequency and size, less that of none.
    likelihood: Array


@kernel
def loudest(errors: Array, by_turn: Array, tau: Array, chosen: BoolArray) -> float:
    """Power of the loudest tone alone, see :func:`powers`."""
    found: float = powers(errors, by_turn, tau, chosen).loudest
    return found


@kernel
def powers(errors: Array, by_turn: Array, tau: Array, chosen: BoolArray) -> Powers:
    """How loud each tone is among errors.

    A first look that takes microseconds, because it leaves the motion as it is.

    Args:
        errors, by_turn, tau: of the points, see
            :func:`rs_localizer.estimation.residuals.linearized`.
        chosen: (n,) the points that count.
    """
    likelihood = np.zeros((len(CYCLES), len(SWINGS) - 1))
    sums, known = np.zeros((_BINS, 3)), np.zeros(3)
    squared, count = 0.0, 0
    for i in range(len(errors)):
        if chosen[i]:
            place = _bin(tau[i])
            for axis in range(3):
                first, second = by_turn[i, 0, axis], by_turn[i, 1, axis]
                sums[place, axis] += first * errors[i, 0] + second * errors[i, 1]
                known[axis] += first * first + second * second
            squared += errors[i, 0] ** 2 + errors[i, 1] ** 2
            count += 1
    if not squared > 0.0:
        return Powers(0.0, likelihood)
    # The squares of a wave are a half in the mean; squared errors are those of two coordinates.
    variance = max(0.5 * squared / count, LEAST_NOISE * LEAST_NOISE)
    most, power = 0.0, np.empty(3)
    explained, volume = _of_sizes(known, variance)
    for m in range(len(CYCLES)):
        power[:] = 0.0
        for wave in range(2):
            x, y, z = 0.0, 0.0, 0.0
            for place in range(_BINS):
                along = _WAVES[wave, m, place]
                x += along * sums[place, 0]
                y += along * sums[place, 1]
                z += along * sums[place, 2]
            power[0] += x * x
            power[1] += y * y
            power[2] += z * z
        total = 0.0
        for axis in range(3):
            power[axis] *= 2.0 / (variance * max(known[axis], _LITTLE))
            total += power[axis]
        most = max(most, total)
        for k in range(len(volume)):
            for axis in range(3):
                likelihood[m, k] += explained[k, axis] * power[axis]
            likelihood[m, k] -= volume[k]
    return Powers(most, likelihood)


@kernel
def _of_sizes(known: Array, variance: float) -> tuple[Array, Array]:
    """What part of half the powers (s-1,3) swings of each size explain, and what they cost (s-1,).

    Of each axis there are two coefficients, known by half the squares (3,) of the turns.
    """
    explained, volume = np.empty((len(SWINGS) - 1, 3)), np.zeros(len(SWINGS) - 1)
    for k in range(len(volume)):
        for axis in range(3):
            ratio = 0.5 * SWINGS[k + 1] ** 2 * known[axis] / variance
            explained[k, axis] = 0.5 * ratio / (1.0 + ratio)
            volume[k] += np.log(1.0 + ratio)
    return explained, volume


@kernel
def spectrum(
    errors: Array, columns: Array, by_turn: Array, tau: Array, chosen: BoolArray,
    known: Columns, freedom: float, noise: float,
) -> Array:  # fmt: skip
    """Logarithm of the marginal likelihood (m,s) of tones of all frequencies and sizes.

    Args:
        errors, by_turn, tau: of the points.
        columns: (n,2,p) derivatives of the errors by all that is fitted beside the tone.
        chosen: (n,) the points that count.
        known: products of these columns, with the prior.
        freedom: degrees of freedom of the errors beside the motion.
        noise: px, a first estimate.
    """
    base = columns.shape[2]
    shared = _shared_by_rows(errors, columns, by_turn, tau, chosen)
    size = base + _TONE
    products, right = np.zeros((size, size)), np.zeros(size)
    for i in range(base):
        write(products[i, :base], known.products[i])
    write(right[:base], known.with_errors)
    evidence = np.empty((len(CYCLES), len(SWINGS)))
    for m in range(len(CYCLES)):
        _with_tone(shared, m, base, products, right)
        left = project_out(products, right, known.squared_errors, _TONE)
        write(evidence[m], evidence_of_sizes(left, SWINGS, freedom, noise)[0])
    return evidence


@kernel
def spread_by_tones(
    errors: Array, columns: Array, by_turn: Array, tau: Array, chosen: BoolArray,
    covariance: Array, noise: float, evidence: Array,
) -> Array:  # fmt: skip
    """What a tone, if there is one, adds to the covariance (18,18) of the motion that is the best
    without one: second moments of the step to the middle row of the motion with it.

    Args:
        errors, columns, by_turn, tau, chosen: as of :func:`spectrum`; columns of the motion alone.
        covariance: (18,18) of the motion without a tone.
        noise: px.
        evidence: (m,s) of all frequencies and sizes.
    """
    probabilities = np.exp(evidence - np.max(evidence[:, 1:]))
    probabilities[:, 0] = 0.0
    probabilities /= probabilities.sum()
    shared = _shared_by_rows(errors, columns, by_turn, tau, chosen)
    base, variance = columns.shape[2], noise * noise
    size = base + _TONE
    products, right = np.zeros((size, size)), np.zeros(size)
    added = np.zeros((base, base))
    for m in range(len(CYCLES)):
        if probabilities[m].max() < _HARDLY:
            continue
        _with_tone(shared, m, base, products, right)
        along = np.ascontiguousarray(products[base:, :base])
        pulled = along @ covariance / variance
        beside = products[base:, base:] - pulled @ along.T
        moments = np.zeros((_TONE, _TONE))
        for k in range(1, len(SWINGS)):
            if probabilities[m, k] < _HARDLY:
                continue
            known = beside.copy()
            for i in range(_TONE):
                known[i, i] += variance / SWINGS[k] ** 2
            inverse = inverted(known)
            swings = inverse @ right[base:]
            moments += probabilities[m, k] * (np.outer(swings, swings) + variance * inverse)
        way = -pulled
        for axis in range(3):
            way[axis, axis] += 1.0
            way[3 + axis, _RATE + axis] += 2.0 * math.pi * CYCLES[m]
        added += way.T @ moments @ way
    return added


@kernel
def _shared_by_rows(
    errors: Array, columns: Array, by_turn: Array, tau: Array, chosen: BoolArray
) -> Array:
    """What turns at a row have in common with the columns, turns and errors there: (bins,3,p+4)."""
    base = columns.shape[2]
    shared = np.zeros((_BINS, 3, base + 4))
    for i in range(len(errors)):
        if chosen[i]:
            at = shared[_bin(tau[i])]
            for axis in range(3):
                for line in range(2):
                    turn = by_turn[i, line, axis]
                    for k in range(base):
                        at[axis, k] += turn * columns[i, line, k]
                    for other in range(3):
                        at[axis, base + other] += turn * by_turn[i, line, other]
                    at[axis, base + 3] += turn * errors[i, line]
    return shared


@kernel
def _with_tone(shared: Array, tone: int, base: int, products: Array, right: Array) -> None:
    """Fill in the rows and columns of a tone behind the others."""
    for k in range(base, len(right)):
        right[k] = 0.0
        products[k] = 0.0
    for place in range(_BINS):
        at = shared[place]
        if at[0, base] == 0.0:
            continue
        for wave in range(2):
            along = _WAVES[wave, tone, place]
            first = base + 3 * wave
            for axis in range(3):
                row, there = products[first + axis], at[axis]
                right[first + axis] -= along * there[base + 3]
                for k in range(base):
                    row[k] += along * there[k]
                for other in range(2):
                    both = along * _WAVES[other, tone, place]
                    for k in range(3):
                        row[base + 3 * other + k] += both * there[base + k]
    for k in range(base, len(right)):
        for j in range(base):
            products[j, k] = products[k, j]
