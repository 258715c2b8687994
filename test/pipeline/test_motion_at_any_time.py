# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose and twist between frames and after them."""

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.recording import make_camera_info
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import simulate_frames
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

from .clouds import cloud_of

CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
MOTION = ConstantVelocity(np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.5)


def frames_of(**settings):
    """After all frames of a motion; their stamps (ns)."""
    localizer = FrameLocalizer(NodeConfig(readout_time=0.03, **settings))
    localizer.calibrate(read_camera_info(make_camera_info(CAMERA, 0, "camera")))
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    stamps = []
    for frame in simulate_frames(CAMERA, MOTION, world, FrameSettings(points=150, outliers=0.0)):
        assert localizer.localize(cloud_of(frame.stamp_ns, frame.points, frame.pixels))
        stamps.append(frame.stamp_ns)
    return localizer, stamps


def test_nothing_is_said_beyond_what_frames_tell():
    localizer, stamps = frames_of(max_prediction=0.05)
    assert localizer.at(stamps[-1] + 200_000_000) is None
    assert localizer.at(stamps[0] - 2_000_000_000) is None
    localizer.reset()
    assert localizer.at(stamps[-1]) is None
    alone, stamps = frames_of(tracking=False)
    assert not alone.predicts
    assert alone.at(stamps[-1]) is None
