# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion over several frames, against dense least squares by SciPy, and predictions."""

import numpy as np
import pytest
from numpy.polynomial import legendre
from scipy.integrate import quad
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from rs_localizer.config import Acceleration
from rs_localizer.core.shutter import carried, motion_of
from rs_localizer.core.state import step_between
from rs_localizer.estimation import window as window_module
from rs_localizer.estimation.prior import Prior, motion_terms, with_motion
from rs_localizer.estimation.robust import apply_step
from rs_localizer.estimation.window import (
    Gaussian,
    MotionSample,
    MotionWindow,
    acceleration_covariance,
    told_of,
)

from ..moving import AT_REST, estimate_at  # noqa: TID252 - Python has a package "test"
from .frames import alike

FADING, PERIOD = 0.03, 1.0 / 30.0  # s
SPAN = 0.03
STILL = np.concatenate([np.eye(3).ravel(), np.zeros(15)])
# Motions small enough that turns add up.
SMALL = 1e-3
HAND = SMALL * np.repeat([10.0, 4.0], 3)  # rad/s^2, m/s^2
# Deviations of what a frame sees of each number of its motion; accelerations it does not see.
NOISE = SMALL * np.repeat([3e-4, 2e-3, 0.05, 0.1], 3)
SEEN = np.diag(np.concatenate([NOISE**-2.0, np.zeros(6)]))
WIDE = np.diag((SMALL * np.repeat([0.1, 0.1, 1.0, 1.0, 10.0, 4.0], 3)) ** 2)


# Of way, velocity and acceleration over a period: transition, and noise of a unit.
DYNAMICS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, 0.0, -1.0 / FADING]])
STEP = expm(PERIOD * DYNAMICS)
REACHED = np.array([expm((k + 0.5) * PERIOD / 400 * DYNAMICS)[:, 2] for k in range(400)])
UNIT_NOISE = PERIOD / 400 * 2.0 / FADING * REACHED.T @ REACHED


def whole(block, sizes=(1.0,) * 6):
    """(18,18) of a block (3,3) for each axis: way, velocity, acceleration of turn and place."""
    return np.kron(block, np.diag(np.square(sizes)))


def simulated(deviations, count, rng, state=None):
    """Small motions (count,18) about rest, whose accelerations have these deviations (6,)."""
    factor = np.linalg.cholesky(UNIT_NOISE)
    if state is None:
        state = np.zeros((6, 3))
        state[:, 2] = deviations * rng.normal(size=6)
    path = []
    for _ in range(count):
        state = state @ STEP.T + deviations[:, None] * (rng.normal(size=(6, 3)) @ factor.T)
        path.append(state.T.ravel())
    return np.array(path), state


def samples_of(path, rng, first=0):
    found = []
    for k, truth in enumerate(path):
        seen = np.append(truth[:12] + NOISE * rng.normal(size=12), np.zeros(6))
        time_ns = round(1e9 * PERIOD * (first + k + 1))
        found.append(MotionSample(time_ns, apply_step(STILL, seen), SEEN, np.zeros(18)))
    return found


def through(samples, window=None):
    began = Gaussian(0, STILL, WIDE)
    window = window or MotionWindow.begin(began, Acceleration(HAND[0], HAND[3]))
    for sample in samples:
        window = window.joined(sample)
    return window


def dense(samples, deviations):
    """All motions at once by least squares: means (n + 1,18) and covariances (n + 1,18,18)."""
    n, move = len(samples) + 1, whole(STEP)
    information, right = np.zeros((n, 18, n, 18)), np.zeros((n, 18))
    information[0, :, 0] += np.linalg.inv(WIDE)
    inverse = np.linalg.inv(whole(UNIT_NOISE, deviations))
    for k, sample in enumerate(samples):
        information[k, :, k] += move.T @ inverse @ move
        information[k, :, k + 1] -= move.T @ inverse
        information[k + 1, :, k] -= inverse @ move
        information[k + 1, :, k + 1] += inverse + sample.information
        right[k + 1] = sample.information @ step_between(STILL, sample.state)
    covariance = np.linalg.inv(information.reshape(18 * n, 18 * n))
    means = (covariance @ right.ravel()).reshape(n, 18)
    return means, [covariance.reshape(n, 18, n, 18)[k, :, k] for k in range(n)]


@pytest.fixture
def as_learnt(monkeypatch):
    """Let accelerations be as large as they were learnt, which the dense form has."""
    monkeypatch.setattr(window_module, "_GROWN", ())


@pytest.mark.usefixtures("as_learnt")
def test_it_is_least_squares_over_all_its_frames():
    rng = np.random.default_rng(0)
    path, _ = simulated(0.1 * HAND, window_module.LENGTH - 1, rng)
    samples = samples_of(path, rng)
    window = through(samples)
    means, covariances = dense(samples, np.repeat(window.deviations, (1, 1, 1, 3)))
    scale = np.sqrt(np.diag(covariances[-1]))
    for k in range(window_module.LENGTH):
        found = window.before(len(samples) - k)
        alike(step_between(STILL, found.state), means[k], scale, atol=0.03)
        alike(found.covariance, covariances[k], scale, atol=0.01, rtol=0.01)
        assert found.time_ns == (0 if k == 0 else samples[k - 1].time_ns)


@pytest.mark.parametrize(
    ("before", "after", "frames", "low", "high"),
    # From a hand to a blow, and back; to a tripod, of which noise leaves no more to be told.
    [(0.1, 10.0, 4, 0.5, 2.0), (10.0, 1.0, 12, 0.5, 2.0), (1.0, 0.03, 16, 0.0, 10.0)],
)
def test_scales_are_learnt_from_both_sides_within_a_few_frames(before, after, frames, low, high):
    rng = np.random.default_rng(2)
    found = []
    for _ in range(20):
        path, state = simulated(before * HAND, 8, rng)
        window = through(samples_of(path, rng))
        state[:, 2] = after * HAND * rng.normal(size=6)
        path, _ = simulated(after * HAND, frames, rng, state)
        found.append(through(samples_of(path, rng, 8), window).deviations)
    typical = np.exp(np.mean(np.log(found), axis=0)) / HAND[[0, 1, 2, 3]]
    assert np.all(typical > low * after), typical
    assert np.all(typical < high * after), typical


@pytest.mark.usefixtures("as_learnt")
def test_between_frames_it_passes_through_both_and_after_them_it_spreads():
    rng = np.random.default_rng(4)
    path, _ = simulated(0.5 * HAND, 5, rng)
    window = through(samples_of(path, rng))
    before, last = window.before(1), window.newest
    for near, frame in ((before.time_ns + 1000, before), (last.time_ns - 1000, last)):
        found = window.at(near)
        np.testing.assert_allclose(found.state, frame.state, atol=1e-3 * SMALL)
        alike(found.covariance, frame.covariance, np.sqrt(np.diag(frame.covariance)), atol=0.02)
    middle = window.at((before.time_ns + last.time_ns) // 2)
    turn = step_between(before.state, middle.state)[:3]
    halfway = 0.5 * step_between(before.state, last.state)[:3]
    np.testing.assert_allclose(turn, halfway, atol=3e-3 * SMALL)
    grown = [np.trace(window.at(last.time_ns + ms * 10**6).covariance[:3, :3])
             for ms in (0, 10, 30, 100)]  # fmt: skip
    assert np.all(np.diff(grown) > 0.0)
    assert window.at(window.start.time_ns - 1) is None


@pytest.mark.parametrize("seconds", [PERIOD, 10 * PERIOD])
def test_between_two_frames_of_a_fast_camera_a_covariance_is_positive(seconds):
    """Velocities are uncertain by 60 m/s, places by 10 um: nothing may be a difference of both."""
    seen = np.repeat([1e-6, 1e-5, 0.1, 1.0], 3)
    before = np.diag(np.concatenate([seen[:6], np.repeat([0.05, 60.0, 1.0, 0.5], 3)]) ** 2)
    window = MotionWindow.begin(Gaussian(0, STILL, before), Acceleration(1.0, 0.5))
    sample = samples_of(np.zeros((1, 18)), np.random.default_rng(1))[0]._replace(
        time_ns=round(1e9 * seconds), information=np.diag(np.append(seen**-2.0, np.zeros(6)))
    )
    window = window.joined(sample)
    for share in (0.1, 0.3, 0.5, 0.7, 0.9):
        between = window.at(round(share * sample.time_ns)).covariance
        scale = np.sqrt(between.diagonal())
        assert np.linalg.eigvalsh(between / np.outer(scale, scale))[0] > 0.0


def test_a_last_image_that_tells_nothing_lies_between_no_two():
    rng = np.random.default_rng(4)
    samples = samples_of(simulated(0.5 * HAND, 5, rng)[0], rng)
    rare = [each._replace(time_ns=6 * each.time_ns) for each in samples]
    nothing = rare[-1]._replace(information=np.zeros((18, 18)), gradient=np.zeros(18))
    window = through([*rare[:-1], nothing])
    assert np.isfinite(window.newest.covariance).all()


UNITS = np.repeat([1.0, 1.0, SPAN, SPAN, SPAN**2, SPAN**2], 3)  # per readout


def test_points_tell_what_the_posterior_knows_beside_its_prior():
    rng = np.random.default_rng(6)
    root = rng.normal(size=(18, 18))
    information = 1e4 * root[:, :10] @ root[:, :10].T  # some numbers are not seen at all
    gradient = information @ (1e-3 * rng.normal(size=18))
    spread = 1e-4 * (root @ root.T + np.eye(18))
    known = with_motion(
        motion_terms((1.0, 1.0), (1.0, 1.0)),
        Prior(motion=AT_REST, covariance=spread), np.zeros(3),
    )  # fmt: skip
    before = np.linalg.inv(spread)
    before[6:12, 6:12] += np.eye(6)  # the velocities of the settings
    posterior = np.linalg.inv(information + before)
    state = apply_step(STILL, posterior @ gradient)
    motion = motion_of((state[:9].reshape(3, 3), *state[9:].reshape(5, 3)))
    sample = told_of(estimate_at(motion, joint_covariance=posterior, span=SPAN), 7, known)
    scale = np.sqrt(np.diag(information + before))
    alike(sample.information / np.outer(UNITS, UNITS), information, scale, atol=2e-3)
    # The gradient at the estimate: the points pull as much as the prior holds.
    left = gradient - information @ (posterior @ gradient)
    alike(sample.gradient / UNITS, left, scale, atol=1e-2 * np.abs(left / scale).max())


ACCELERATIONS = np.array([0.02, -0.01, 0.015, 0.004, 0.003, -0.002])


def predicted(state, readouts):
    """State (24,) some readouts later, and its derivative (18,18)."""
    numbers = state[:9].reshape(3, 3), *state[9:].reshape(5, 3)
    later, transport = carried(numbers, readouts, FADING / SPAN)
    return np.concatenate([each.ravel() for each in later]), transport


def some_state(accelerations):
    rng, rotation = np.random.default_rng(3), Rotation.random(random_state=1).as_matrix()
    return np.concatenate(
        [rotation.ravel(), rng.normal(size=3), 0.05 * rng.normal(size=6), accelerations]
    )


@pytest.mark.parametrize("readouts", [0.7, 1.1, 15.0])
def test_accelerations_fade_and_leave_their_velocity_and_way(readouts):
    first = some_state(ACCELERATIONS)
    later, _ = predicted(first, readouts)

    def left(s):
        return np.exp(-s * SPAN / FADING)

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
    first = some_state(np.zeros(6))
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
    found = acceleration_covariance(Acceleration(3.0, 2.0), dt, SPAN)
    nodes, weights = legendre.leggauss(40)
    reached = np.array([expm(0.5 * dt * (node + 1.0) * DYNAMICS)[:, 2] for node in nodes])
    expected = dt / FADING * np.einsum("k,ki,kj->ij", weights, reached, reached)
    units = np.array([1.0, SPAN, SPAN**2])  # way, and what is per readout
    expected *= np.outer(units, units)
    for first, deviation in ((0, 3.0), (3, 2.0)):
        for axis in range(3):
            own = np.arange(first + axis, 18, 6)
            block = found[np.ix_(own, own)]
            np.testing.assert_allclose(block, deviation**2 * expected, rtol=exact)
            found[np.ix_(own, own)] = 0.0
    assert not found.any()
