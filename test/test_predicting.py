# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Predictions by themselves: how motions and errors are carried on, and what comes in between."""

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.config import Acceleration
from rs_localizer.core import shutter
from rs_localizer.core.shutter import carried, numbers_of
from rs_localizer.core.state import step_between
from rs_localizer.estimation.prior import state_in
from rs_localizer.estimation.robust import apply_step
from rs_localizer.estimation.window import acceleration_covariance

READOUT = 0.03
FADING = 0.03  # s
ACCELERATIONS = np.array([0.02, -0.01, 0.015, 0.004, 0.003, -0.002])


def motion_of(vector):
    return rsl.Motion(
        vector[:9].reshape(3, 3), vector[9:12], vector[12:15], vector[15:18],
        angular_acceleration=vector[18:21], linear_acceleration=vector[21:],
    )  # fmt: skip


def state(motion):
    return state_in(motion, np.zeros(3))


def start(accelerations):
    rng = np.random.default_rng(3)
    rotation = Rotation.random(random_state=1).as_matrix()
    return np.concatenate(
        [rotation.ravel(), rng.normal(size=3), 0.05 * rng.normal(size=6), accelerations]
    )


def predict(vector, spread, readouts, fading):
    later, transport = carried(numbers_of(motion_of(vector)), readouts, fading)
    return shutter.motion_of(later), transport @ spread @ transport.T


@pytest.mark.parametrize("readouts", [0.7, 1.1, 15.0])
def test_accelerations_fade_and_leave_their_velocity_and_way(readouts):
    fading = FADING / READOUT
    first = motion_of(start(ACCELERATIONS))
    later, _ = predict(start(ACCELERATIONS), np.eye(18), readouts, fading)

    def left(s):
        return np.exp(-s / fading)

    faster = quad(left, 0, readouts)[0]
    farther = quad(lambda s: (readouts - s) * left(s), 0, readouts)[0]
    turn = Rotation.from_rotvec(
        readouts * first.angular_velocity + farther * first.angular_acceleration
    ).as_matrix()
    way = readouts * first.linear_velocity + farther * first.linear_acceleration
    np.testing.assert_allclose(later.rotation.T, first.rotation.T @ turn, atol=1e-12)
    centre = -first.rotation.T @ first.translation + first.rotation.T @ way
    np.testing.assert_allclose(-later.rotation.T @ later.translation, centre, atol=1e-12)
    velocity = first.linear_velocity + faster * first.linear_acceleration
    np.testing.assert_allclose(turn @ later.linear_velocity, velocity, atol=1e-12)
    np.testing.assert_allclose(
        turn @ later.linear_acceleration, left(readouts) * first.linear_acceleration, atol=1e-12
    )
    np.testing.assert_allclose(
        later.angular_acceleration, left(readouts) * first.angular_acceleration, atol=1e-12
    )


@pytest.mark.parametrize("readouts", [0.7, 1.1, 15.0])
def test_errors_are_carried_along_to_first_order(readouts):
    fading = FADING / READOUT
    factor = 0.1 * np.random.default_rng(3).normal(size=(18, 18))
    spread, first = factor @ factor.T, start(np.zeros(6))
    later, covariance = predict(first, spread, readouts, fading)

    def moved(step):
        """Where the prediction goes when the start moves."""
        other, _ = predict(apply_step(first, step), spread, readouts, fading)
        return step_between(state(later), state(other))

    steps = 1e-6 * np.eye(18)
    jacobian = np.stack([(moved(step) - moved(-step)) / 2e-6 for step in steps], axis=1)
    expected = jacobian @ spread @ jacobian.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(
        covariance / np.outer(scale, scale), expected / np.outer(scale, scale), atol=1e-6
    )


# The closed form is left for a series below 3 ms.
@pytest.mark.parametrize(("dt", "exact"), [(0.001, 0.02), (0.0029, 0.05), (0.0031, 1e-6),
                                           (1 / 30, 1e-9), (0.4, 1e-9)])  # fmt: skip
def test_new_accelerations_are_those_of_singers_process(dt, exact):
    found = acceleration_covariance(Acceleration(3.0, 2.0), dt, READOUT)
    dynamics = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / FADING]])
    nodes, weights = legendre.leggauss(40)
    expected = np.zeros((3, 3))
    for node, weight in zip(0.5 * dt * (nodes + 1.0), 0.5 * dt * weights, strict=True):
        reached = expm(node * dynamics)[:, 2]
        expected += weight * 2.0 / FADING * np.outer(reached, reached)
    units = np.array([1.0, READOUT, READOUT**2])  # way, and what is per readout
    expected *= np.outer(units, units)
    for first, deviation in ((0, 3.0), (3, 2.0)):
        for axis in range(3):
            own = np.arange(first + axis, 18, 6)
            block = found[np.ix_(own, own)]
            np.testing.assert_allclose(block, deviation**2 * expected, rtol=exact)
            found[np.ix_(own, own)] = 0.0
    assert not found.any()
