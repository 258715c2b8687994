# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose and twist between frames and after them."""

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.recording import make_camera_info
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.tools.simulation.frames import simulate_frames
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.settings import FrameSettings
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


def squared_deviations(found, stamp_ns):
    """Of pose and of twist from the true ones, each chi-squared with six degrees of freedom."""
    true = MOTION.state(stamp_ns, np.zeros(1))
    turn = so3.log(np.ascontiguousarray(found.pose.rotation @ true.rotations[0].T))
    of_pose = np.concatenate([found.pose.position - true.positions[0], turn])
    linear, angular = true.linear[0], true.angular[0]
    of_twist = np.concatenate([found.twist.linear - linear, found.twist.angular - angular])
    return [
        float(error @ np.linalg.solve(covariance, error))
        for error, covariance in (
            (of_pose, found.pose.covariance),
            (of_twist, found.twist.covariance),
        )
    ]


def test_poses_within_between_and_after_frames_are_in_their_regions():
    localizer, stamps = frames_of(max_prediction=0.1)
    last, spread = stamps[-1], []
    for after in (-60, -35, -10, 5, 40, 90):  # ms
        found = localizer.at(last + 1_000_000 * after)
        assert found.stamp_ns == last + 1_000_000 * after
        assert len(found.inliers) == 0
        assert max(squared_deviations(found, found.stamp_ns)) < 22.5  # 99.9 %
        spread.append(np.trace(found.pose.covariance))
    assert spread[-1] > spread[-2] > spread[-3]


def test_nothing_is_said_beyond_what_frames_tell():
    localizer, stamps = frames_of(max_prediction=0.05)
    assert localizer.at(stamps[-1] + 200_000_000) is None
    assert localizer.at(stamps[0] - 2_000_000_000) is None
    localizer.reset()
    assert localizer.at(stamps[-1]) is None
    alone, stamps = frames_of(tracking=False)
    assert not alone.predicts
    assert alone.at(stamps[-1]) is None
