# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Covariances about roll, pitch and yaw are those of these angles, by drawing poses."""

from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.config import NodeConfig
from rs_localizer.io.outputs import BodyPose, Localized
from rs_localizer.io.transforms import TransformTree
from rs_localizer.pipeline.published import about_angles, of_body


def pose(roll: float, pitch: float, yaw: float, root: Any) -> BodyPose:
    rotation = Rotation.from_euler("xyz", [roll, pitch, yaw], degrees=True).as_matrix()
    return BodyPose(np.array([1.0, 2.0, 3.0]), rotation, root @ root.T)


@pytest.mark.parametrize(
    "angles", [(0.0, 0.0, 90.0), (10.0, -20.0, 130.0), (-40.0, 60.0, -70.0), (170.0, 5.0, 0.0)]
)
def test_the_angles_scatter_as_it_says(angles):
    rng = np.random.default_rng(1)
    root = 1e-3 * rng.normal(size=(6, 6))
    true = pose(*angles, root)
    errors = rng.normal(size=(20_000, 6)) @ root.T
    turned = Rotation.from_rotvec(errors[:, 3:]) * Rotation.from_matrix(true.rotation)
    scatter = turned.as_euler("xyz") - np.deg2rad(angles)
    scatter = (scatter + np.pi) % (2 * np.pi) - np.pi
    drawn = np.cov(np.hstack([errors[:, :3], scatter]).T)
    found = about_angles(true).covariance
    size = np.sqrt(np.outer(np.diag(drawn), np.diag(drawn)))
    np.testing.assert_allclose(found / size, drawn / size, atol=0.04)


def test_it_is_published_when_it_is_asked_for():
    unused: Any = None
    side = pose(0.0, 0.0, 90.0, np.diag([1.0, 1.0, 1.0, 0.1, 0.2, 0.3]))
    frame = Localized(5, 5, "map", "camera", side, None, unused, 0, unused)
    for name, variances in (
        ("fixed_axes", [0.01, 0.04, 0.09]),
        ("roll_pitch_yaw", [0.04, 0.01, 0.09]),
    ):
        config = NodeConfig(orientation_covariance=name)
        found: Any = of_body(frame, config, TransformTree())
        np.testing.assert_allclose(np.diag(found.pose.covariance)[3:], variances)
