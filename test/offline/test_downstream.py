# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A replayed flight as the systems downstream get it: frames, signs and covariances of each.

The flight is the independent simulator's; laws of motion and the truth judge, in the axes of those
who listen.
"""

import runpy
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import simulate
from benchmarks.independent.motions import Motions, States, hand
from benchmarks.independent.scenes import Rich
from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.io import recording
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.outputs import Localized, messages
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.offline.replay import TF_TYPE, find_topics, find_transforms, replay
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.map_to_odom import CorrectionState
from rs_localizer.pipeline.published import broadcast
from rs_localizer.settings import build, load_params_file

CONFIG = Path(__file__).parents[2] / "config"
LENGTH = 45
SETTLED = slice(5, None)  # the tracker's first frames are coarser
ENU_TO_NED = np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
FLU_TO_FRD = np.diag([1, -1, -1])


NOISE = 1.0  # px
# The camera looks forward on a body with x forward, y left, z up.
BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
CAMERA_FROM_BASE = Transform(BODY_FROM_CAMERA.T, np.array([0.05, 0.1, -0.2]))


def level(count: int, rng: np.random.Generator) -> Motions:
    """A level body that is carried half as fast as a hand."""
    yaw = np.outer(rng.uniform(-np.pi, np.pi, count), [0.0, 0.0, 1.0])
    rotation = Rotation.from_rotvec(yaw).as_matrix() @ BODY_FROM_CAMERA
    return replace(hand(count, rng, 2.0), rotation=rotation)


def true_states(camera: States) -> tuple[Array, Array, Array, Array]:
    """Position, rotation, linear and angular velocity of the body, from those of its camera."""
    lever = CAMERA_FROM_BASE.translation
    linear = camera.linear + np.cross(camera.angular, lever)
    return (
        camera.position + camera.rotation @ lever,
        camera.rotation @ BODY_FROM_CAMERA.T,
        linear @ BODY_FROM_CAMERA.T,
        camera.angular @ BODY_FROM_CAMERA.T,
    )


@dataclass(frozen=True)
class Flight:
    """A recording, and the truth (LENGTH,...) at the stamps."""

    path: Path
    position: Array
    rotation: Array
    linear: Array
    angular: Array
    odom_from_base: list[Transform]


def write_tf(
    bag: BagWriter, stamp_ns: int, topic: str, ends: tuple[str, str], of: Transform
) -> None:
    stamped = make_transform(make_message, stamp_ns, *ends, of)
    bag.write(topic, make_message(TF_TYPE, transforms=[stamped]), stamp_ns)


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Flight:
    path = tmp_path_factory.mktemp("flight") / "flight"
    frames = simulate(Camera(), level, Rich(), 1, LENGTH, 3)
    truth = true_states(frames.first)
    turned = Rotation.from_euler("z", 50.0, degrees=True).as_matrix()
    odometry = []
    with BagWriter(path) as bag:
        start = int(frames.stamp_ns[0])
        mounting = CAMERA_FROM_BASE.inverse()
        write_tf(bag, start, "/tf_static", ("base_link", recording.CAMERA_FRAME), mounting)
        for index in range(LENGTH):
            stamp_ns = int(frames.stamp_ns[index])
            points, pixels = frames.seen(index, NOISE)
            info = recording.make_camera_info(believed(frames.camera), stamp_ns)
            cloud = recording.make_correspondences(stamp_ns, points, pixels, np.arange(len(points)))
            bag.write(recording.CAMERA_INFO_TOPIC, info, stamp_ns)
            bag.write(recording.CORRESPONDENCES_TOPIC, cloud, stamp_ns)
            # Wheels that began elsewhere, and slip by 2 cm a second.
            drift = np.array([1.0, -2.0, 0.5]) + 0.02 * index / 30
            odometry.append(Transform(turned @ truth[1][index], turned @ truth[0][index] + drift))
            write_tf(bag, stamp_ns, "/tf", ("odom", "base_link"), odometry[-1])
    return Flight(path, *truth, odometry)


def replayed(flight: Flight, config: NodeConfig) -> tuple[list[Localized], CameraFrames]:
    with open_bag(flight.path) as bag:
        topics = find_topics(bag)
        used = CameraFrames(config, transforms=find_transforms(bag, topics, config))
        found = [answer.result for answer in replay(bag, topics, used)]
    assert all(found)
    assert len(found) == LENGTH
    return found, used


@pytest.fixture(scope="module")
def frames(flight) -> list[Localized]:
    return replayed(flight, NodeConfig(readout_time=0.03, base_frame="base_link"))[0]


def squared(errors: Array, covariances: Array) -> float:
    """Mean squared error in standard deviations, per component."""
    each = np.einsum("ni,nij,nj->n", errors, np.linalg.inv(covariances), errors)
    return float(np.mean(each)) / errors.shape[1]


def turns(found: Any, true: Any) -> Array:
    vectors: Array = (Rotation.from_matrix(found) * Rotation.from_matrix(true).inv()).as_rotvec()
    return vectors


def test_odometry_is_that_of_the_body_in_the_map(flight, frames):
    """For mavros and robot_localization, which turn it into their frames themselves."""
    odometry = [messages(frame, make_message)["odometry"] for frame in frames][SETTLED]
    assert {(m.header.frame_id, m.child_frame_id) for m in odometry} == {("map", "base_link")}
    poses = [m.pose.pose for m in odometry]
    position = np.array([[p.position.x, p.position.y, p.position.z] for p in poses])
    rotation = Rotation.from_quat(
        [[p.orientation.x, p.orientation.y, p.orientation.z, p.orientation.w] for p in poses]
    ).as_matrix()
    of_pose = np.hstack(
        [position - flight.position[SETTLED], turns(rotation, flight.rotation[SETTLED])]
    )
    covariances = np.array([m.pose.covariance.reshape(6, 6) for m in odometry])
    assert 0.3 < squared(of_pose, covariances) < 2.0
    twists = [m.twist.twist for m in odometry]
    velocity = (
        np.array([[*vars_of(t.linear), *vars_of(t.angular)] for t in twists])
        - np.hstack([flight.linear, flight.angular])[SETTLED]
    )
    covariances = np.array([m.twist.covariance.reshape(6, 6) for m in odometry])
    # It changes its velocities less than the default of acceleration.* allows for.
    assert 0.15 < squared(velocity, covariances) < 2.0


def vars_of(vector: SimpleNamespace) -> tuple[float, float, float]:
    return vector.x, vector.y, vector.z


def test_px4_gets_the_same_in_its_axes(flight, frames):
    odometry = [messages(frame, make_message)["odometry"] for frame in frames]
    px4 = runpy.run_path(str(CONFIG.parent / "examples" / "px4_odometry.py"))
    assert not any(map(px4["jumps"], odometry, odometry[1:]))
    fields = [px4["vehicle_odometry"](message, "ned", 0, 0) for message in odometry[SETTLED]]

    def column(name: str) -> Array:
        return np.array([item[name] for item in fields], dtype=float)

    rotation = Rotation.from_quat(np.roll(column("q"), -1, axis=1)).as_matrix()
    true = ENU_TO_NED @ flight.rotation[SETTLED] @ FLU_TO_FRD
    in_body = np.einsum("nji,nj->ni", true, turns(rotation, true))
    errors = {
        "position": column("position") - flight.position[SETTLED] @ ENU_TO_NED.T,
        "orientation": in_body,
        "velocity": column("velocity") - flight.linear[SETTLED] @ FLU_TO_FRD.T,
    }
    for name, error in errors.items():
        assert 0.08 < np.mean(error**2 / column(f"{name}_variance")) < 2.0, name
    rates = column("angular_velocity") - flight.angular[SETTLED] @ FLU_TO_FRD.T
    assert np.median(np.abs(rates)) < np.deg2rad(5.0)


def test_nav2_finds_the_robot_by_its_odometry(flight):
    """With config/nav2.yaml: map -> odom, with odom -> base_link of that moment, is the pose."""
    config = build(load_params_file(CONFIG / "nav2.yaml") | {"readout_time": 0.03})
    found, used = replayed(flight, config)
    state = CorrectionState()
    for index, frame in enumerate(found):
        sent, state = broadcast(frame, config, used.transforms, state)
        assert sent is not None
        assert (sent.parent, sent.child) == ("map", "odom")
        assert sent.stamp_ns == frame.stamp_ns + 200_000_000  # usable until the next one comes
        robot = sent.parent_from_child @ flight.odom_from_base[index]
        assert np.linalg.norm(robot.translation - flight.position[index]) < 0.05
        assert np.linalg.norm(turns(robot.rotation, flight.rotation[index])) < np.deg2rad(1.0)
