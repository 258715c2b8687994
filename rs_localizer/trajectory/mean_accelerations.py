"""Accelerations of a motion that is known by its positions, beside what an accelerometer felt.

Nothing is differentiated. Positions averaged with a cardinal B-spline of degree k - 2, second
differences taken of the means a spacing apart, are exactly the accelerations averaged with the
B-spline of degree k (B_k'' is the second difference of B_{k-2}). The readings, turned into the
map's axes, are averaged with the latter: both sides are then the same number, and a linear
equation of scale, gravity, bias and lever arm. This is the weak form of p'' = a, with B-splines as
test functions; what it says at frequencies above the spacing's is nothing on both sides.

For a camera in units of the map at p, with an IMU at l (m) in the camera's axes, ``R`` the
camera's axes in the map and ``C`` the IMU's in the camera:

    s p'' + (R l)'' = R C (f - b) + g
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline

from rs_localizer.core.arrays import Array
from rs_localizer.trajectory.spline import Layout, Spline

DEGREE = 5
"""Of the B-spline that accelerations are averaged with; positions with two less."""
_SUPPORT = DEGREE + 1  # spacings
# Positions are averaged over so many of them a spacing.
_STEPS = 20
# Without a sample for longer than this (s), or than so many usual steps, there is a gap.
_LONGEST_STEP, _MOST_STEPS = 0.02, 2.5
# So many means at once.
_MOST = 20


@dataclass(frozen=True, slots=True, eq=False)
class ForceSamples:
    """What an accelerometer measured."""

    times: Array  # (k,) s, of the spline
    forces: Array  # (k,3) m/s^2, specific force in its own axes; upwards at rest


@dataclass(frozen=True, slots=True, eq=False)
class Means:
    """Mean accelerations around n moments that follow each other."""

    spacing: float  # s
    times: Array  # (n,) s
    seen: Array  # (n,3) of the camera's centre, units of the map per s^2, along its axes
    forces: Array  # (n,3) m/s^2, likewise
    axes: Array  # (n,3,3) of the IMU, in the map's: what a bias of the readings does
    arms: Array  # (n,3,3) second derivative of the camera's axes, 1/s^2
    weights: Array  # (n,) about 1: of what is the same all the time


def mean_accelerations(
    spline: Spline, samples: ForceSamples, camera_from_imu: Array, spacing: float
) -> list[Means]:
    """Means of all parts of a motion that samples cover without a gap.

    Args:
        camera_from_imu: (3,3).
        spacing: s, of the means; half the period of the quickest motion that counts.
    """
    found = []
    for start, end in _covered(spline.layout, samples.times):
        count = int((end - start) / spacing - _SUPPORT + 1.0 + 1e-9)
        for first in range(0, count, _MOST):
            numbers = np.arange(first, min(first + _MOST, count))
            times = np.asarray(start + spacing * (0.5 * _SUPPORT + numbers), np.float64)
            found.append(_means(spline, samples, camera_from_imu, spacing, times))
    return found


def _covered(layout: Layout, times: Array) -> list[tuple[float, float]]:
    """Intervals (s) of stretches with samples without a gap."""
    if len(times) < 2:
        return []
    steps = np.diff(times)
    gaps = np.flatnonzero(steps > max(_LONGEST_STEP, _MOST_STEPS * float(np.median(steps))))
    pieces = [(part[0], part[-1]) for part in np.split(times, gaps + 1)]
    return [
        (max(start, first), min(end, last))
        for start, end in zip(layout.starts, layout.ends, strict=True)
        for first, last in pieces
        if max(start, first) < min(end, last)
    ]


def _means(
    spline: Spline, samples: ForceSamples, camera_from_imu: Array, spacing: float, times: Array
) -> Means:
    reach = 0.5 * _SUPPORT * spacing
    low, high = np.searchsorted(samples.times, [times[0] - reach, times[-1] + reach])
    near = slice(max(int(low) - 1, 0), int(high) + 1)
    at = samples.times[near]
    turns = spline.states(at).rotations @ camera_from_imu
    # Trapezoids; the B-spline is zero at both ends.
    weights = _kernel(DEGREE, (at - times[:, None]) / spacing) * np.gradient(at) / spacing
    # Positions are averaged at places that lie alike beside all means: second differences of what
    # rises evenly are zero, whatever the steps are.
    step = spacing / _STEPS
    dense = times[0] - reach + step * np.arange(_STEPS * (len(times) - 1 + _SUPPORT) + 1)
    states = spline.states(dense)
    middles = times[0] + spacing * np.arange(-1, len(times) + 1)
    average = _kernel(DEGREE - 2, (dense - middles[:, None]) / spacing) / _STEPS
    return Means(
        spacing,
        times,
        _second_differences(average @ states.positions, spacing),
        np.einsum("nk,kij,kj->ni", weights, turns, samples.forces[near], optimize=True),
        np.einsum("nk,kij->nij", weights, turns),
        _second_differences(np.einsum("nk,kij->nij", average, states.rotations), spacing),
        weights.sum(axis=1),
    )


def _kernel(degree: int, places: Array) -> Array:
    """The centred cardinal B-spline of a degree."""
    knots = np.arange(degree + 2) - 0.5 * (degree + 1)
    values = BSpline.basis_element(knots, extrapolate=False)(places)
    return np.nan_to_num(np.asarray(values, np.float64))


def _second_differences(values: Array, spacing: float) -> Array:
    return np.asarray((values[2:] - 2.0 * values[1:-1] + values[:-2]) / spacing**2)
