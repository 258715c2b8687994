# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames: every point where its own row sees it, noise and outliers as ordered."""

import numpy as np
import pytest

from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.trajectories import Trajectory
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import (
    SimulatedFrame,
    frame_stamps,
    simulate_frames,
)
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import ConstantVelocity, RecordedMotion

K = np.array([[400.0, 0.0, 319.5], [0.0, 410.0, 239.5], [0.0, 0.0, 1.0]])
MOTION = ConstantVelocity(np.array([0.6, -2.0, 1.5]), np.array([1.0, 0.5, 0.25]), 1.0)
MAP = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
CLEAN = FrameSettings(points=100, noise=0.0, outliers=0.0)


def camera(direction: str = "top_to_bottom") -> Camera:
    return Camera(640, 480, K, readout_time=0.03, scan_direction=direction)


def frames(direction: str = "top_to_bottom") -> list[SimulatedFrame]:
    return list(simulate_frames(camera(direction), MOTION, MAP, CLEAN))


@pytest.mark.parametrize("direction", list(ScanDirection))
def test_each_point_is_seen_at_the_time_of_its_row(direction):
    """Independent of row_time and project_rolling: plain geometry at each pixel's exposure."""
    for frame in frames(direction=direction)[::10]:
        assert len(frame.points) == 100
        u, v = frame.pixels.T
        late = {
            "top_to_bottom": v / 479,
            "bottom_to_top": (479 - v) / 479,
            "left_to_right": u / 639,
            "right_to_left": (639 - u) / 639,
        }[direction]
        assert late.min() > -0.01
        assert late.max() < 1.01
        state = MOTION.state(frame.stamp_ns, 0.03 * late)
        local = np.einsum("nji,nj->ni", state.rotations, frame.points - state.positions)
        np.testing.assert_allclose(u, 400 * local[:, 0] / local[:, 2] + 319.5, atol=1e-6)
        np.testing.assert_allclose(v, 410 * local[:, 1] / local[:, 2] + 239.5, atol=1e-6)


def test_points_that_a_lens_folds_back_are_not_seen():
    # Strong barrel distortion: beyond 60 degrees off axis the polynomial runs backwards.
    wide = [[200.0, 0.0, 319.5], [0.0, 205.0, 239.5], [0.0, 0.0, 1.0]]
    lens = Camera(640, 480, wide, [-0.35, 0.0, 0.0, 0.0])
    every = FrameSettings(points=5000, noise=0.0, outliers=0.0)
    for frame in list(simulate_frames(lens, MOTION, MAP, every))[::10]:
        x, y, z = frame.motion.rotation @ frame.points.T + frame.motion.translation[:, None]
        np.testing.assert_allclose(lens.rays(frame.pixels), np.c_[x / z, y / z], atol=1e-3)


def test_a_wide_lens_shows_what_lies_behind_it():
    """By equation 12 of Khomutenko, Garcia, Martinet (2016)."""
    wide = [[160.0, 0.0, 319.5], [0.0, 164.0, 239.5], [0.0, 0.0, 1.0]]
    lens = Camera(640, 480, wide, [0.63, 1.05], "eucm")
    behind = 0
    for frame in list(simulate_frames(lens, MOTION, MAP, CLEAN))[::10]:
        x, y, z = frame.motion.rotation @ frame.points.T + frame.motion.translation[:, None]
        scale = 0.63 * np.sqrt(1.05 * (x**2 + y**2) + z**2) + 0.37 * z
        np.testing.assert_allclose(frame.pixels[:, 0], 160 * x / scale + 319.5, atol=1e-6)
        np.testing.assert_allclose(frame.pixels[:, 1], 164 * y / scale + 239.5, atol=1e-6)
        behind += np.count_nonzero(z < 0.0)
    assert behind > 10


def test_no_frame_touches_a_gap():
    t = np.arange(0.0, 3.0, 1 / 120)
    t = t[((t < 1.0) | (t > 1.4)) & ((t < 2.0) | (t > 2.05))]
    stamps_ns = 1_500_000_000_000_000_000 + np.round(t * 1e9).astype(np.int64)
    quaternions = np.tile([0.0, 0.0, 0.0, 1.0], (len(t), 1))
    motion = RecordedMotion(Trajectory(stamps_ns, np.zeros((len(t), 3)), quaternions))
    stamps = np.array(frame_stamps(motion, camera(), 30.0))
    for stamp in stamps:
        inside = [first <= stamp <= last - 30_000_000 for first, last in motion.intervals_ns]
        assert sum(inside) == 1
    seconds = (stamps - stamps_ns[0]) * 1e-9
    np.testing.assert_allclose(seconds * 30, np.round(seconds * 30), atol=1e-6)
    # All that fit are there: 90 in three seconds, less those that touch 0.4 s and 0.05 s.
    assert 70 <= len(stamps) <= 75
