# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The derivatives of three frames together are those of finite differences."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer as rsl
from rs_localizer.estimation import frames_together as together

K = np.array([[500.0, 0.0, 320.0], [0.0, 490.0, 240.0], [0.0, 0.0, 1.0]])
CAMERA = rsl.Camera(640, 480, K, readout_time=0.03)
TIMES = (0, 33_000_000, 70_000_000)  # ns, of unlike intervals


def three_frames():
    """Points before a camera that turns and moves, as pinhole pixels of each frame's middle row."""
    rng, posed = np.random.default_rng(4), []
    points = rng.uniform((-1.0, -0.8, 3.0), (1.0, 0.8, 5.0), (30, 3))
    for k, time_ns in enumerate(TIMES):
        turn = Rotation.from_rotvec(0.03 * (k + 1) * np.array([1.0, -2.0, 0.5])).as_matrix()
        inside = points @ turn.T + 0.05 * k
        pixels = inside[:, :2] / inside[:, 2:] @ K[:2, :2].T + K[:2, 2]
        found = rsl.Localizer(CAMERA).localize(points, pixels)
        posed.append(together.Fitted(time_ns, found, points, pixels))
    return posed


@pytest.mark.parametrize("k", range(3))
def test_derivatives_are_finite_differences(k):
    posed, middle = three_frames(), np.array([0.6, 0.5])
    centre = posed[0].points.mean(axis=0)
    frames = together._frames(rsl.Localizer(CAMERA)._exposure, posed, centre)
    poses = [(each.found.rotation, each.found.position - centre) for each in posed]

    def errors(step):
        moved = [
            (
                np.ascontiguousarray(Rotation.from_rotvec(-turn).as_matrix() @ rotation),
                place + rotation.T @ way,
            )
            for (rotation, place), (turn, way) in zip(
                poses, step[:18].reshape(3, 2, 3), strict=True
            )
        ]
        fit = together._Fit(moved, step[18:], np.zeros(0))
        return together._linearized(frames, fit, k, middle)

    _, columns = errors(np.zeros(22))
    # By focal length and aspect ratio the motion between two rows is left out: some 4 %.
    most = np.repeat([1e-3, 0.05], [20, 2])
    for j, unit in enumerate(1e-5 * np.eye(22)):
        expected = (errors(unit)[0] - errors(-unit)[0]) / 2e-5
        scale = np.abs(expected).max()
        np.testing.assert_allclose(columns[:, :, j], expected, atol=most[j] * scale, err_msg=str(j))
