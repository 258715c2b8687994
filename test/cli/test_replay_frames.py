# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay`` with base_frame and publish_tf: transforms from the recording."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import CAMERA, SHUTTER, flight, tf, write_ros1
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.trajectories import read_tum, read_twists
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_recording import write_simulated
from rs_localizer.tools.simulation.simulated_settings import FrameSettings

FRAMES = 5
EYE = "camera_optical_frame"
# A camera that looks to the left from the front of a base.
LEVER = np.array([0.5, 0.2, 0.9])
TURN = Rotation.from_matrix([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@pytest.fixture(scope="module")
def record(tmp_path_factory) -> Any:
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    settings = FrameSettings(points=100, noise=0.3, outliers=0.2)
    frames = flight(world, FRAMES, settings, 10**12)

    def write(transforms: list[tuple[str, Any]]) -> Path:
        path = tmp_path_factory.mktemp("bags") / "flight"
        with BagWriter(path) as bag:
            for frame in frames:
                write_simulated(bag, CAMERA, frame)
            for topic, message in transforms:  # behind: a recording is read as a whole
                bag.write(topic, message, 2 * 10**12)
        return path

    return write


STATIC = [("/tf_static", tf("base_link", EYE, LEVER, TURN))]


def replayed(bag: Path, out: Path, *settings: str) -> list[tuple[Array, Array, Array, Array]]:
    """Position, quaternion, linear and angular velocity of each frame."""
    assert main(["replay", str(bag), "--out", str(out), *SHUTTER, *settings]) == 0
    poses, twists = read_tum(out / "poses.txt"), read_twists(out / "twists.txt")
    columns = (poses.positions, poses.quaternions, twists.linear, twists.angular)
    return list(zip(*columns, strict=True))


def test_transforms_come_out(record, tmp_path):
    drift = Rotation.from_euler("z", 25.0, degrees=True)
    stamps = [10**12 + 20_000_000 * i for i in range(6)]  # the last frames come later
    odometry = [
        ("/tf", tf("odom", "base_link", (0.1 * i, 0.0, 0.0), drift, stamp))
        for i, stamp in enumerate(stamps)
    ]
    bag = record(STATIC + odometry)
    settings = ("-p", "base_frame:=base_link", "-p", "publish_tf:=map_to_odom")
    poses = replayed(bag, tmp_path / "out", *settings, "-p", "transform_tolerance:=0.05")
    with open_bag(tmp_path / "out" / "result") as result:
        found = [message.transforms[0] for _, _, message in result.messages(["/tf"])]
        inputs = [m.header.stamp for _, _, m in result.messages(["/rs_localizer/pose"])]
    assert 0 < len(found) < len(poses) == FRAMES
    for transform, pose, stamp in zip(found, poses, inputs, strict=False):
        assert (transform.header.frame_id, transform.child_frame_id) == ("map", "odom")
        ahead = transform.header.stamp.sec * 10**9 + transform.header.stamp.nanosec
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        assert ahead == stamp_ns + 50_000_000
        # map_from_odom of where odometry believes the base to be is where it is.
        t, q = transform.transform.translation, transform.transform.rotation
        map_from_odom = Rotation.from_quat([q.x, q.y, q.z, q.w])
        believed = [0.1 * (stamp_ns - 10**12) / 20_000_000, 0.0, 0.0]
        position = np.add(map_from_odom.apply(believed), (t.x, t.y, t.z))
        assert np.allclose(position, pose[0], atol=1e-8)
        turn = (map_from_odom * drift).inv() * Rotation.from_quat(pose[1])
        assert turn.magnitude() < 1e-8


def test_an_old_recording(record, tmp_path):
    # ROS 1 before tf2: another type, slashes before the names, and the mounting on /tf.
    with open_bag(record(STATIC)) as bag:
        messages = list(bag.messages(("/camera_info", "/correspondences")))
    first = messages[0][1]
    for stamp_ns in (first - 10**9, first + 10**9):
        mounting = tf("/base_link", f"/{EYE}", LEVER, TURN, stamp_ns)
        messages.append(("/tf", stamp_ns, mounting))
    bag = write_ros1(tmp_path / "old.bag", messages)
    settings = ("-p", "base_frame:=base_link")
    new = replayed(record(STATIC), tmp_path / "new", *settings)
    for a, b in zip(replayed(bag, tmp_path / "out", *settings), new, strict=True):
        assert all(np.allclose(*pair, atol=1e-6) for pair in zip(a, b, strict=True))
