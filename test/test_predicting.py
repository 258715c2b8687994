# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Predictions by themselves: how motions and errors are carried on, and what comes in between."""

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rs_localizer.config import Acceleration
from rs_localizer.core.shutter import carried
from rs_localizer.core.state import step_between
from rs_localizer.estimation.robust import apply_step
from rs_localizer.estimation.window import acceleration_covariance

READOUT, FADING = 0.03, 0.03  # s
ACCELERATIONS = np.array([0.02, -0.01, 0.015, 0.004, 0.003, -0.002])


def predicted(state, readouts):
    """State (24,) some readouts later, and its derivative (18,18)."""
    numbers = state[:9].reshape(3, 3), *state[9:].reshape(5, 3)
    later, transport = carried(numbers, readouts, FADING / READOUT)
    return np.concatenate([each.ravel() for each in later]), transport


def start(accelerations):
    rng, rotation = np.random.default_rng(3), Rotation.random(random_state=1).as_matrix()
    return np.concatenate(
        [rotation.ravel(), rng.normal(size=3), 0.05 * rng.normal(size=6), accelerations]
    )


@pytest.mark.parametrize("readouts", [0.7, 1.1, 15.0])
def test_accelerations_fade_and_leave_their_velocity_and_way(readouts):
    first = start(ACCELERATIONS)
    later, _ = predicted(first, readouts)

    def left(s):
        return np.exp(-s * READOUT / FADING)

    faster = quad(left, 0, readouts)[0]
    farther = quad(lambda s: (readouts - s) * left(s), 0, readouts)[0]
    place, angular, linear, change, acceleration = first[9:].reshape(5, 3)
    moved, _, later_linear, later_change, later_acceleration = later[9:].reshape(5, 3)
    turn = Rotation.from_rotvec(readouts * angular + farther * change)
    way = readouts * linear + farther * acceleration
    rotation = turn.inv().as_matrix() @ first[:9].reshape(3, 3)
    for found, expected in (
        (later[:9].reshape(3, 3), rotation),
        (turn.apply(moved), place - way),
        (turn.apply(later_linear), linear + faster * acceleration),
        (turn.apply(later_acceleration), left(readouts) * acceleration),
        (later_change, left(readouts) * change),
    ):
        np.testing.assert_allclose(found, expected, atol=1e-12)


@pytest.mark.parametrize("readouts", [0.7, 1.1, 15.0])
def test_errors_are_carried_along_to_first_order(readouts):
    first = start(np.zeros(6))
    later, transport = predicted(first, readouts)

    def moved(step):
        """Where the prediction goes when the start moves."""
        return step_between(later, predicted(apply_step(first, step), readouts)[0])

    jacobian = np.stack([(moved(e) - moved(-e)) / 2e-6 for e in 1e-6 * np.eye(18)], axis=1)
    np.testing.assert_allclose(transport, jacobian, atol=1e-6 * np.abs(jacobian).max())


# The closed form is left for a series below 3 ms.
@pytest.mark.parametrize(("dt", "exact"), [(0.001, 0.02), (0.0029, 0.05), (0.0031, 1e-6),
                                           (1 / 30, 1e-9), (0.4, 1e-9)])  # fmt: skip
def test_new_accelerations_are_those_of_singers_process(dt, exact):
    found = acceleration_covariance(Acceleration(3.0, 2.0), dt, READOUT)
    dynamics = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / FADING]])
    nodes, weights = legendre.leggauss(40)
    reached = np.array([expm(0.5 * dt * (node + 1.0) * dynamics)[:, 2] for node in nodes])
    expected = dt / FADING * np.einsum("k,ki,kj->ij", weights, reached, reached)
    units = np.array([1.0, READOUT, READOUT**2])  # way, and what is per readout
    expected *= np.outer(units, units)
    for first, deviation in ((0, 3.0), (3, 2.0)):
        for axis in range(3):
            own = np.arange(first + axis, 18, 6)
            block = found[np.ix_(own, own)]
            np.testing.assert_allclose(block, deviation**2 * expected, rtol=exact)
            found[np.ix_(own, own)] = 0.0
    assert not found.any()
