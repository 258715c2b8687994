# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A stamp of 0 is a time in a recording that starts there, and elsewhere one that nobody set."""

import numpy as np
import pytest
from recorded import CAMERA, READOUT_TIME, flight

from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.recording import make_camera_info
from rs_localizer.offline.replay import prepare_replay, replay
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings

from ..pipeline.clouds import cloud_of  # noqa: TID252 - Python has a package "test"

YEARS = 17 * 10**17
CONFIG = NodeConfig(readout_time=READOUT_TIME)


@pytest.fixture(scope="module")
def frames():
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=3000)
    return flight(world, 9, FrameSettings(80, 0.5, 0.0), 0)


def answers(path, frames, start_ns, unset=()):
    """What replay answers to frames that begin at ``start_ns``, some of them without a stamp."""
    with BagWriter(path) as bag:
        for k, frame in enumerate(frames):
            then = start_ns + frame.stamp_ns
            cloud = cloud_of(0 if k in unset else then, frame.points, frame.pixels)
            bag.write("/camera_info", make_camera_info(CAMERA, then), then)
            bag.write("/correspondences", cloud, then)
    with open_bag(path) as bag:
        return [a.result for a in replay(bag, *prepare_replay(bag, CONFIG))]


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
