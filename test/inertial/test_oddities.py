# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a contradicted gyroscope has is read off its turns between images."""

import re
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.inertial.oddities import ComparedTurns
from rs_localizer.inertial.samples import ImuSamples

PERIOD_NS = 33_333_333
SWAY = np.array([[0.6, 2.1, 0.4], [0.5, 3.2, 1.7], [0.4, 4.4, 3.0]])  # rad/s, rad/s, rad of x, y, z


def rates(times, axes=3):
    """Angular velocities (n,3) of a hand that turns about so many of its axes."""
    size, speed, phase = SWAY.T
    return (size * np.cos(speed * times[:, None] + phase)) * (np.arange(3) < axes)


def told(matrix, axes=3):
    """What a gyroscope shows by ``matrix`` (3,3) of the camera's rates, at 0.05 deg of noise."""
    rng, compared = np.random.default_rng(5), ComparedTurns()
    times_ns = np.arange(-200, 900) * 2_500_000
    every = rates(1e-9 * times_ns, axes)
    samples = ImuSamples(times_ns, every @ np.transpose(matrix) + 0.01)
    turn = Rotation.identity()
    fine = np.arange(0, 60 * PERIOD_NS, PERIOD_NS // 20)
    for k, rate in enumerate(rates(1e-9 * fine, axes)):
        if k % 20 == 0:
            seen = Rotation.from_rotvec(rng.normal(0.0, np.radians(0.05), 3)) * turn
            motion = SimpleNamespace(rotation=np.ascontiguousarray(seen.as_matrix()))
            compared.add(samples, SimpleNamespace(middle_ns=int(fine[k]), motion=motion))
        turn = Rotation.from_rotvec(-rate * 1e-9 * PERIOD_NS / 20) * turn
    return compared.told()


QUARTER = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


@pytest.mark.parametrize(
    ("matrix", "words"),
    [
        (np.eye(3), ""),
        (1.1 * np.eye(3), ""),  # the track learns it
        (2.0 * np.eye(3), "it shows 2 times the camera's rates"),
        (57.3 * np.eye(3), "it shows 5. times the camera's rates: degrees, not radians"),
        (np.eye(3) / 57.3, "it shows 0.01. times the camera's rates: not degrees"),
        (np.zeros((3, 3)), "it always shows the same rates"),
        (np.diag([1.0, -1.0, -1.0]), "the camera's x y z are its x -y -z"),
        (QUARTER, "the camera's x y z are its -y x z"),
        (np.diag([1.0, -1.0, 1.0]), ".* are its x -y z, which no mount does: a sign is wrong"),
        (57.3 * QUARTER, ".* are its -y x z and it shows 5. times .*: degrees, not radians"),
        (Rotation.from_rotvec([0.0, 0.5, 0.0]).as_matrix(), "its mount is 29 deg off"),
    ],
)
def test_axes_signs_and_units_are_named(matrix, words):
    assert re.fullmatch(words, told(matrix))


def test_turns_about_few_axes_tell_nothing():
    assert told(QUARTER, axes=1) == ""
