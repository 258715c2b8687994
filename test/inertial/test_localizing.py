# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Frames with a known turn: the truth comes back whatever shakes, and nothing changes without."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera
from rs_localizer.core.rotation_prior import ROTATION
from rs_localizer.core.shake import COMBINATIONS, MIDDLE_RATES, MIDDLE_VALUES, shake_functions
from rs_localizer.core.so3 import log
from rs_localizer.inertial import turning
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings
from rs_localizer.inertial.turning import BETWEEN, GyroscopeErrors, read
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at

from ..moving import Moving  # noqa: TID252 - Python has a package "test"

READOUT_TIME = 0.03
MIDDLE_NS = 10**12
TRUE = Camera(distortion=(0.0,) * 5, readout_time=READOUT_TIME)
SETTINGS = InertialSettings(2e-4, 1e-4)


class Shaken(Moving):
    """A hand's turn and a vibration of 0.3 deg at 60 Hz about one axis each, 0.5 m/s."""

    def __init__(self, vibration=0.3, turn=40.0, velocity=(0.3, -0.4, 0.1)):
        start, self.velocity = Rotation.from_rotvec([0.3, -0.2, 0.5]), np.array(velocity)

        def way(t):
            swing = np.radians(vibration) * np.sin(2.0 * np.pi * 60.0 * t + 0.7) * [0.6, 0.8, 0.0]
            turned = Rotation.from_rotvec(np.radians(turn) * t * [0.0, 0.0, 1.0])
            place = np.array([0.1, 0.2, -3.0]) + self.velocity * t
            return start * turned * Rotation.from_rotvec(swing), place

        super().__init__(way, TRUE)

    def rate(self, times):
        """Body rates (n,3) rad/s by differences."""
        step = 1e-6
        (before, _), (after, _) = self.pose(times - step), self.pose(times + step)
        return (before.inv() * after).as_rotvec() / (2.0 * step)

    def samples(self, rate=4000.0, reach=0.06):
        """A noise-free gyroscope about the middle row."""
        times = np.arange(-round(reach * rate), round(reach * rate) + 1) / rate
        return ImuSamples(MIDDLE_NS + np.rint(1e9 * times).astype(np.int64), self.rate(times))

    def all_around(self, count=60):
        """Points (n,3) and raw pixels (n,2), each exposed with its own row."""
        rng = np.random.default_rng(0)
        (rotation,), (position,) = self.pose([0.0])
        around = [rng.uniform(-reach, reach, count) for reach in (0.54, 0.405)]
        local = np.column_stack([*around, np.ones(count)]) * rng.uniform(2.0, 5.0, (count, 1))
        points = rotation.apply(local) + position
        return points, self.pixels(0.0, points)


def errors(mean=(0.0,) * 10):
    covariance = np.diag([1e-8, 1e-8, 1e-8, 1e-10, *6 * [1e-8]])
    return GyroscopeErrors(np.asarray(mean), covariance, 1e-5)


def _turned_by(numbers):
    """Turn (3,) from the first to the last row by rate, change and in-frame turn (60,)."""
    tau = np.array([-0.5, 0.5])
    values = shake_functions(tau)[0] + MIDDLE_VALUES + np.outer(tau, MIDDLE_RATES)
    functions = np.column_stack([tau, 0.5 * tau**2, values @ COMBINATIONS]) @ numbers.reshape(20, 3)
    return functions[1] - functions[0]


def known(samples, of):
    """The rotation prior of a frame by samples of a gyroscope with these errors."""
    track = GyroscopeTrack(SETTINGS, READOUT_TIME)
    track.errors = of
    return track.ahead(samples, MIDDLE_NS, None).rotation


@pytest.mark.parametrize("solver", ["r6p_vcwt", "p3p"])
def test_the_truth_comes_back_under_vibration(solver):
    shaken = Shaken(velocity=np.zeros(3)) if solver == "p3p" else Shaken()
    points, pixels = shaken.all_around()
    rotation = known(shaken.samples(), errors())
    found = Localizer(believed(TRUE), solver=solver).localize(points, pixels, rotation=rotation)
    assert found
    assert found.inliers.all()
    for tau in (-0.5, 0.0, 0.31):
        t = tau * READOUT_TIME
        (turned,), (position,) = shaken.pose([t])
        pose, twist = pose_at(found, tau), twist_at(found, tau, READOUT_TIME)
        off = Rotation.from_matrix(pose.rotation) * turned.inv()
        assert np.degrees(off.magnitude()) < 2e-4
        assert np.linalg.norm(pose.position - position) < 2e-5
        assert np.degrees(np.abs(twist.angular - shaken.rate(np.array([t]))).max()) < 0.1
        np.testing.assert_allclose(twist.linear, turned.inv().apply(shaken.velocity), atol=2e-3)


@pytest.mark.parametrize(
    ("far", "since"), [(0.0, 33_000_000), (0.1, 33_000_000), (0.1, -21_000_000)]
)
def test_derivatives_by_what_the_gyroscope_is_off_by(far, since):
    """By differences, from none of it and from a scale and a mount that are far off.

    The other frame may come later.
    """
    samples = Shaken(vibration=0.02).samples(rate=397.0)  # none at the ends
    start, step = errors(far * np.r_[0, 0, 0, 0, 1, -1, 0.5, 0.6, 0.5, -1]), 1e-4
    found = read(samples, MIDDLE_NS, READOUT_TIME, start, MIDDLE_NS - since)
    for k in range(10):
        sides = [errors(start.mean + side * np.eye(10)[k]) for side in (step, -step)]
        later, sooner = (
            read(samples, MIDDLE_NS, READOUT_TIME, one, MIDDLE_NS - since).between for one in sides
        )
        by = -log(np.ascontiguousarray(later @ sooner.T)) / (2.0 * step)
        np.testing.assert_allclose(
            found.by_errors[BETWEEN, k], by, atol=3e-3 + 0.02 * abs(by).max(), err_msg=str(k)
        )
        # From the first row to the last one.
        turns = [known(samples, one).at_rows(np.array([-0.5, 0.5]))[0] for one in sides]
        by = np.subtract(*(log(turn[0] @ turn[1].T) for turn in turns)) / (2.0 * step)
        whole = _turned_by(found.by_errors[3:, k])
        np.testing.assert_allclose(whole, by, atol=3e-3 + 0.02 * abs(by).max(), err_msg=str(k))


def test_a_frame_long_ago_makes_no_rotation_within_this_one_slow(monkeypatch):
    solved, usual = [], turning.smoothed
    monkeypatch.setattr(turning, "smoothed", lambda *of: solved.append(len(of[0])) or usual(*of))
    shaken = Shaken(vibration=0.02)
    found = read(shaken.samples(reach=1.1), MIDDLE_NS, READOUT_TIME, errors(), MIDDLE_NS - 10**9)
    assert max(solved) < 200
    then, now = shaken.pose(np.array([-1.0, 0.0]))[0]
    expected = (now.inv() * then).as_matrix()
    assert np.degrees(np.linalg.norm(log(np.ascontiguousarray(found.between @ expected.T)))) < 0.01


def test_a_vibration_of_unknown_phase_is_no_rotation_that_is_known():
    """Averaged over its period it vanishes; what is left counts as vibration without a phase."""
    shaken = Shaken(vibration=0.3, turn=0.0)
    samples = shaken.samples(rate=400.0, reach=0.2)
    exact, vague = errors(), errors()
    vague.covariance[3, 3] = 0.02**2
    sure, unsure = (known(samples, one) for one in (exact, vague))
    fastest = [np.abs(one.at_rows(np.linspace(-0.5, 0.5, 41))[1]).max() for one in (sure, unsure)]
    assert fastest[0] > READOUT_TIME * 0.5 * 2.0 * np.pi * 60.0 * np.radians(0.3)
    assert fastest[1] < 0.05 * fastest[0]
    # Turns from the first to the last row, which a phase that nobody knows makes.
    by_numbers = np.array([_turned_by(one) for one in np.eye(60)]).T
    turns = [by_numbers @ one.covariance[np.ix_(ROTATION, ROTATION)] @ by_numbers.T
             for one in (sure, unsure)]  # fmt: skip
    # sin(60 Hz (t + T/2) + p) - sin(60 Hz (t - T/2) + p) = 2 sin(60 Hz T/2) cos(60 Hz t + p)
    swing = 2.0 * np.sin(np.pi * 60.0 * READOUT_TIME) * np.radians(0.3) / np.sqrt(2.0)
    assert np.trace(turns[0]) < (0.05 * swing) ** 2
    assert np.trace(turns[1]) == pytest.approx(swing**2, rel=0.3)
