# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A stamp of 0 is a time in a recording that starts there, and elsewhere one that nobody set."""

import numpy as np
import pytest

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.recording import make_camera_info
from rs_localizer.offline.replay import prepare_replay, replay
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import simulate_frames
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, readout_time=0.03)
YEARS = 17 * 10**17
MOTION = ConstantVelocity(np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.3)


@pytest.fixture(scope="module")
def frames():
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=3000)
    return list(simulate_frames(CAMERA, MOTION, world, FrameSettings(80, 0.5, 0.0)))


def answers(path, frames, start_ns, unset=()):
    """What replay answers to frames that begin at ``start_ns``, some of them without a stamp."""
    with BagWriter(path) as bag:
        for k, frame in enumerate(frames):
            then = start_ns + frame.stamp_ns
            rows = np.empty(len(frame.points), [(name, "<f8") for name in "xyzuv"])
            for name, column in zip("xyzuv", [*frame.points.T, *frame.pixels.T], strict=True):
                rows[name] = column
            cloud = make_cloud(make_message, 0 if k in unset else then, "map", rows)
            bag.write("/camera_info", make_camera_info(CAMERA, then), then)
            bag.write("/correspondences", cloud, then)
    with open_bag(path) as bag:
        return [a.result for a in replay(bag, *prepare_replay(bag, NodeConfig(readout_time=0.03)))]


def test_a_recording_that_starts_at_zero_has_its_first_frame(tmp_path, frames):
    found = answers(tmp_path / "bag", frames, 0)
    assert all(found)
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in frames]
    assert found[0].stamp_ns == 0


def test_frames_without_a_stamp_end_no_track(tmp_path, frames):
    found = answers(tmp_path / "bag", frames, YEARS, unset=(0, 3, 4))
    assert [k for k, result in enumerate(found) if not result] == [0, 3, 4]
    assert {found[k].reason for k in (0, 3, 4)} == {"no_stamp"}
    assert [result.estimate.tracked for result in found if result][1:] == [True] * (len(found) - 4)
