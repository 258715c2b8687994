# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of several cameras: how they move, what they see and when, by other formulas."""

import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import open_bag
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.rigs import RigParts, mounted_lenses, node_parameters
from rs_localizer.settings import write_parameters

K = np.array([[450.0, 0.0, 320.0], [0.0, 450.0, 240.0], [0.0, 0.0, 1.0]])
TURN = Rotation.from_euler("xyz", [0.1, -0.2, np.pi]).as_matrix()
PLACE = np.array([0.1, -0.2, 0.05])


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rig")
    cameras = {
        "front": Camera(640, 480, K, readout_time=0.03),
        "rear": Camera(640, 480, K, None, "plumb_bob", 0.02, "bottom_to_top"),
    }
    poses = {"front": (np.eye(3), np.zeros(3)), "rear": (TURN, PLACE)}
    parts = RigParts(cameras, poses, {"front": 0.0, "rear": -0.25})
    write_parameters(folder / "chain.yaml", node_parameters(parts), mounted_lenses(parts))
    out = folder / "seen"
    still = ("--duration", 1, "--noise", 0, "--outliers", 0)
    turn = ("--angular-velocity", 0.4, 0.8, -0.5)
    record(out, "--rig", folder / "chain.yaml", *still, *turn)
    return out, parts


def test_pixels_are_those_of_the_row_by_the_cameras_own_clock(recording):
    out, parts = recording
    angular, stamps = np.array([0.4, 0.8, -0.5]), {}
    start = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    with open_bag(out) as bag:
        for name, readout in (("front", 0.03), ("rear", 0.02)):
            clouds = [m for _, _, m in bag.messages((f"/{name}/correspondences",))]
            stamps[name] = [read_correspondences(m).stamp_ns for m in clouds]
            cloud = read_correspondences(clouds[-1])
            rotation, translation = parts.camera_from_rig[name]
            row = cloud.pixels[:, 1] / 479.0
            row = row if name == "front" else 1.0 - row
            # The rig starts to turn about its origin at 1 s of true time; stamps of rear are late.
            times = 1e-9 * cloud.stamp_ns - 1.0 + parts.time_offset[name] + readout * row
            for point, pixel, time in zip(cloud.points, cloud.pixels, times, strict=True):
                map_from_rig = start @ Rotation.from_rotvec(angular * time).as_matrix()
                x, y, z = rotation @ (map_from_rig.T @ point) + translation
                np.testing.assert_allclose(pixel, [450 * x / z + 320, 450 * y / z + 240], atol=2e-3)
    assert all(len(own) >= 28 for own in stamps.values())
    # Clocks run freely: neither at once, nor at the same rate.
    pairs = min(len(s) for s in stamps.values())
    apart = np.array(stamps["rear"][:pairs]) - stamps["front"][:pairs] - 250_000_000
    assert np.abs(apart).min() > 1e5
    assert np.ptp(apart) > 1e3
