# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A global shutter is told from a rolling one by what changes from frame to frame."""

import numpy as np

from rs_localizer.trajectory.online_readout import ShutterHypotheses
from rs_localizer.trajectory.readout_equations import SIDE, Equations

SET = 0.02
NOISE = 1e-3


def odds(
    true: float, speed: float = 0.3, offset: float = 0.01, shaking: float = 0.0, count: int = 20
) -> ShutterHypotheses:
    """Of triples whose velocities are off by the same everywhere, by ten times the noise."""
    rng = np.random.default_rng(1)
    off = rng.normal(0.0, offset, SIDE)
    x = speed * np.cumsum(rng.normal(size=(count, SIDE)), axis=0) / np.sqrt(count)
    images = rng.normal(0.0, NOISE, (count + 2, SIDE)) + rng.normal(0.0, shaking, (count + 2, SIDE))
    y = true * x + off + (images[:-2] + 4.0 * images[1:-1] + images[2:]) / 6.0
    none = np.zeros((count, SIDE, SIDE))
    yy = np.broadcast_to(0.5 * NOISE**2 * np.eye(SIDE), none.shape)
    found = ShutterHypotheses()
    for k in range(2, count + 1):
        of = Equations(x, y, none, none, yy)
        found.add(Equations(*(np.ascontiguousarray(part[k - 2 : k]) for part in of)), SET)
    return found


def test_a_global_shutter_is_found_behind_errors_of_the_map():
    found = odds(0.0, speed=1.0)
    assert found.certain
    assert found.doubtful


def test_of_a_shutter_as_it_is_set_there_is_no_doubt():
    found = odds(SET, speed=1.0)
    assert not any((found.certain, found.doubtful, found.may_be_reversed))
    assert found.logarithm < -4.6


def test_at_rest_nothing_is_known():
    assert abs(odds(0.0, speed=0.0).logarithm) < 1e-9
    assert not odds(0.0, speed=0.0).doubtful
    assert ShutterHypotheses().logarithm == 0.0


def test_a_camera_that_shakes_within_its_frames_has_no_global_shutter():
    found = odds(0.0, speed=3.0, shaking=10.0 * NOISE)
    assert found.logarithm > 4.6
    assert not found.certain


def test_a_reversed_shutter_may_be_reversed_and_is_no_global_one():
    found = odds(-SET, speed=1.0)
    assert found.may_be_reversed
    assert found.doubtful
    assert not found.certain


def test_two_jolts_make_no_global_shutter():
    found, none = odds(0.0, speed=0.0), np.zeros((2, SIDE, SIDE))
    x, y = np.zeros((2, SIDE)), np.full((2, SIDE), 0.01)
    x[1] = 100.0
    of = Equations(x, y, none, none, np.broadcast_to(0.5 * NOISE**2 * np.eye(SIDE), none.shape))
    for _ in range(2):
        found.add(of, SET)
    assert found.doubtful
    assert not found.certain
