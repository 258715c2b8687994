# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A global shutter is told from a rolling one by what changes from frame to frame."""

import numpy as np
import pytest

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
    assert odds(0.0, speed=1.0).certain


def test_of_a_shutter_as_it_is_set_there_is_no_doubt():
    found = odds(SET, speed=1.0)
    assert not found.certain
    assert found.logarithm < -4.6


def test_at_rest_nothing_is_known():
    assert abs(odds(0.0, speed=0.0).logarithm) < 1e-9
    assert ShutterHypotheses().logarithm == 0.0


def test_a_camera_that_shakes_within_its_frames_has_no_global_shutter():
    found = odds(0.0, speed=3.0, shaking=10.0 * NOISE)
    assert found.logarithm > 4.6
    assert not found.certain


def test_a_reversed_shutter_may_be_reversed_and_is_no_global_one():
    found = odds(-SET, speed=1.0)
    assert found.may_be_reversed
    assert not found.certain
    assert not odds(SET, speed=1.0).may_be_reversed


@pytest.mark.parametrize("true", [0.0, -SET])
def test_a_camera_that_moves_otherwise_than_is_set_is_doubted(true):
    assert odds(true, speed=1.0).doubtful
    assert not odds(SET, speed=1.0).doubtful
    assert not odds(true, speed=0.0).doubtful


def test_two_jolts_make_no_global_shutter():
    found = odds(0.0, speed=0.0)
    count = 2
    x, y = np.zeros((count, SIDE)), np.full((count, SIDE), 0.01)
    x[1] = 100.0
    none = np.zeros((count, SIDE, SIDE))
    of = Equations(x, y, none, none, np.broadcast_to(0.5 * NOISE**2 * np.eye(SIDE), none.shape))
    found.add(of, SET)
    found.add(of, SET)
    assert found.doubtful
    assert not found.certain
