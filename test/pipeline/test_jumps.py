# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Jumps are poses that do not follow from the last one; all else is a filter's daily bread."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.io.outputs import Localized, Pose, Twist
from rs_localizer.pipeline.px4 import Jumps

PERIOD = 1 / 30


def frame(
    seconds: float, position: Any = (0.0, 0.0, 0.0), turn: Any = (0.0, 0.0, 0.0), **others: Any
) -> Localized:
    """1 cm and 0.5 deg; 0.1 m/s and 1 deg/s where it has a twist."""
    unused: Any = None
    pose = Pose(
        np.array(position),
        Rotation.from_rotvec(turn).as_matrix(),
        np.diag([1e-4] * 3 + [7.6e-5] * 3),
    )
    stamp = round((100.0 + seconds) * 1e9)
    given = {"map_frame": "map", "twist": None} | others
    return Localized(stamp, stamp, body_frame="base", pose=pose, inliers=unused, dropped=0,
                     estimate=unused, **given)  # fmt: skip


def twist(linear: Any = (0.0, 0.0, 0.0), angular: Any = (0.0, 0.0, 0.0)) -> Twist:
    return Twist(np.array(linear), np.array(angular), np.diag([1e-2] * 3 + [3e-4] * 3))


@pytest.fixture
def jumps() -> Jumps:
    return Jumps(NodeConfig)


def test_a_flight_that_goes_on_has_none(jumps):
    velocity, rate = np.array([5.0, 0.0, 0.0]), np.array([0.0, 0.0, 2.0])
    position, rng = np.zeros(3), np.random.default_rng(0)
    for index in range(60):
        turn = rate * index * PERIOD
        noise = rng.normal(size=6) * [*[0.01] * 3, *[8.7e-3] * 3]
        seen = Rotation.from_rotvec(noise[3:]) * Rotation.from_rotvec(turn)
        moving = {"twist": twist(velocity, rate)}
        made = frame(index * PERIOD, position + noise[:3], seen.as_rotvec(), **moving)
        assert jumps.add(made) == 0
        position = position + Rotation.from_rotvec(turn).apply(velocity) * PERIOD


@pytest.mark.parametrize(
    ("position", "turn"), [((0.0, 0.3, 0.0), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.3, 0.0, 0.0))]
)
def test_a_step_that_nobody_makes_is_one(jumps, position, turn):
    jumps.add(frame(0.0, twist=twist()))
    assert jumps.add(frame(PERIOD, position, turn, twist=twist())) == 1
    assert jumps.add(frame(2 * PERIOD, position, turn, twist=twist())) == 1  # it stays there


def test_after_a_gap_a_camera_may_be_elsewhere(jumps):
    jumps.add(frame(0.0, twist=twist()))
    assert jumps.add(frame(1.0, (0.3, 0.0, 0.0), twist=twist())) == 0


def test_without_a_twist_any_camera_may_move(jumps):
    jumps.add(frame(0.0))
    assert jumps.add(frame(PERIOD, (0.1, 0.0, 0.0), (0.2, 0.0, 0.0))) == 0  # 3 m/s, 6 rad/s
    assert jumps.add(frame(2 * PERIOD, (2.0, 0.0, 0.0))) == 1


def test_another_map_and_a_clock_that_goes_back_are_jumps(jumps):
    jumps.add(frame(1.0))
    assert jumps.add(frame(1.0 + PERIOD, map_frame="other")) == 1
    assert jumps.add(frame(0.0, map_frame="other")) == 2
