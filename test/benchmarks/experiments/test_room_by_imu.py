"""The judge of metres by an IMU: of a map that is right, errors are small."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.experiments.room_by_imu import table, weighed
from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.io.trajectories import read_tum
from rs_localizer.mapping.refine import RefinedMap
from rs_localizer.simulation.true_motion import RecordedMotion
from rs_localizer.trajectory.spline import Layout, Spline

SECONDS = 6.0


@pytest.fixture(scope="module")
def motion() -> RecordedMotion:
    return RecordedMotion(read_tum(data.path(data.HAND_MOTION)).part(slice(1700, 2900)))


def refined_of(motion: RecordedMotion, size: float) -> RefinedMap:
    """The true motion in a map of this size."""
    start_ns = motion.intervals_ns[0][0] + 10**9
    layout = Layout.over(np.array([[0.0, SECONDS]]), 0.005)
    true = motion.state(start_ns, layout.control_times())
    none, empty = np.zeros((0, 3)), np.zeros(0)
    return RefinedMap(
        points=none, covariances=np.zeros((0, 3, 3)), refined=empty > 0, sights=np.zeros(0, int),
        camera=Camera(640, 480, np.diag([500.0, 500.0, 1.0])), readout_time=0.03,
        readout_time_deviation=np.nan, asked_readout=None, deviation=0.1, squared_errors=empty,
        inliers=empty > 0, before=1.0, after=0.1,
        spline=Spline(layout, true.rotations, true.positions / size), start_ns=start_ns,
        times=np.arange(0.0, SECONDS, 1 / 15),
    )  # fmt: skip


def test_a_map_that_is_right(motion: RecordedMotion) -> None:
    """Of any size."""
    found = weighed(motion, refined_of(motion, 3.0), 0)
    assert abs(found.scale_error) < 0.004
    assert found.gravity_error < 0.1
    assert abs(found.offset_error) < 3e-4


def test_the_table(motion: RecordedMotion) -> None:
    *lines, last = table(motion, refined_of(motion, 1.0), 1)
    assert len(lines) == 2
    assert last.startswith("rms of 1: scale 0.")
