# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every published quantity of a body that carries a camera, against a hand-written chain of frames.

The chain is of 4x4 matrices, from the map to the body; velocities are differences of it, and
covariances come from differences of it and from a Monte Carlo simulation.
"""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import rs_localizer.pipeline.camera_frames
import rs_localizer.tracking
from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core.arrays import Array
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.outputs import Localized
from rs_localizer.io.transforms import (
    NotYetError,
    Transform,
    TransformError,
    TransformTree,
    make_transform,
)
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.frames import ANY_CALIBRATION
from rs_localizer.pipeline.map_to_odom import CorrectionState
from rs_localizer.pipeline.published import Broadcast, broadcast
from rs_localizer.pipeline.refusal import Refusal

from ..moving import estimate_at  # noqa: TID252 - Python has a package "test"
from .motions import covariance_of, disturbed

READOUT_TIME = 0.03
STAMP_NS = 5_000_000_000
# Axes of the optical frame (right, down, forward) in a body's (forward, left, up): REP-103.
OPTICAL = [[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]


def matrix(translation: Any, rotation: Any) -> Array:
    result = np.eye(4)
    result[:3, 3], result[:3, :3] = translation, rotation
    return result


def turned(axis: str, degrees: float) -> Array:
    result: Array = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return result


# A mast to the front left, tilted; on it a camera that looks to the left and a little down.
BASE_FROM_MAST = matrix([0.4, 0.3, 0.9], turned("y", 5.0))
MAST_FROM_CAMERA_LINK = matrix([0.0, 0.1, 0.25], turned("z", 90.0) @ turned("y", 12.0))
CAMERA_LINK_FROM_CAMERA = matrix([0.01, 0.02, 0.0], OPTICAL)
CAMERA_FROM_BASE = np.linalg.inv(BASE_FROM_MAST @ MAST_FROM_CAMERA_LINK @ CAMERA_LINK_FROM_CAMERA)


def tf(parent: str, child: str, pose: Array, seconds: float = 0.0) -> SimpleNamespace:
    transform = Transform(pose[:3, :3], pose[:3, 3])
    item = make_transform(make_message, round(seconds * 1e9), parent, child, transform)
    return SimpleNamespace(transforms=[item])


@pytest.fixture
def robot() -> TransformTree:
    tree = TransformTree()
    tree.add(tf("base_link", "mast", BASE_FROM_MAST), static=True)
    tree.add(tf("mast", "camera_link", MAST_FROM_CAMERA_LINK), static=True)
    tree.add(tf("camera_link", "camera", CAMERA_LINK_FROM_CAMERA), static=True)
    return tree


def estimate() -> Estimate:
    rng = np.random.default_rng(0)
    deviations = np.repeat([0.003, 0.01, 0.02, 0.05, 0.01, 0.02], 3)
    root = rng.normal(size=(18, 18)) * deviations[:, None]
    motion = Motion(
        Rotation.from_rotvec([0.3, -0.2, 0.5]).as_matrix(), np.array([0.1, -0.2, 2.0]),
        np.array([0.05, -0.1, 0.2]), np.array([0.02, 0.05, -0.01]),
    )  # fmt: skip
    return estimate_at(motion, 8, joint_covariance=root @ root.T, span=READOUT_TIME)


class Chain:
    """Map to body as a function of time: the truth."""

    def __init__(self, motion: Motion, middle: float) -> None:
        self.motion = motion
        self.middle = middle  # s: when the middle row is exposed

    def camera_from_base(self, seconds: float) -> Array:
        return CAMERA_FROM_BASE

    def map_from_base(self, motion: Motion, seconds: float) -> Array:
        # Also beyond the rows, which an estimate refuses.
        rotation, translation = Motion.at(motion, (seconds - self.middle) / READOUT_TIME)
        map_from_camera = np.linalg.inv(matrix(translation, rotation))
        result: Array = map_from_camera @ self.camera_from_base(seconds)
        return result

    def twist(self, motion: Motion, seconds: float) -> Array:
        step = 1e-5
        now = self.map_from_base(motion, seconds)
        before = self.map_from_base(motion, seconds - step)
        after = self.map_from_base(motion, seconds + step)
        linear = now[:3, :3].T @ (after - before)[:3, 3] / (2 * step)
        angular = Rotation.from_matrix(before[:3, :3].T @ after[:3, :3]).as_rotvec() / (2 * step)
        return np.concatenate([linear, angular])

    def pose_error(self, seconds: float, error: Array) -> Array:
        right = self.map_from_base(self.motion, seconds)
        wrong = self.map_from_base(disturbed(self.motion, error), seconds)
        about = Rotation.from_matrix(wrong[:3, :3] @ right[:3, :3].T).as_rotvec()
        return np.concatenate([(wrong - right)[:3, 3], about])

    def twist_error(self, seconds: float, error: Array) -> Array:
        wrong = self.twist(disturbed(self.motion, error), seconds)
        return wrong - self.twist(self.motion, seconds)


class Panning(Chain):
    """The mast turns by the hour hand's way, at half a radian per second."""

    RATE = -0.5

    def base_from_mast(self, seconds: float) -> Array:
        turn = Rotation.from_rotvec([0.0, 0.0, self.RATE * seconds]).as_matrix()
        return matrix([0.4, 0.3, 0.9], turn @ turned("y", 5.0))

    def camera_from_base(self, seconds: float) -> Array:
        chain = self.base_from_mast(seconds) @ MAST_FROM_CAMERA_LINK @ CAMERA_LINK_FROM_CAMERA
        return np.linalg.inv(chain)


class KnowsTheMotion(Localizer):
    def localize(self, *given: Any, **more: Any) -> Estimate:
        return replace(estimate(), span=self.camera.readout_time)

    find = localize

    def accepted(self, found: Estimate) -> Estimate:
        return found

    def known_of(self, *given: Any) -> Any:
        pass


@pytest.fixture(autouse=True)
def known_motion(monkeypatch) -> None:
    monkeypatch.setattr(rs_localizer.pipeline.camera_frames, "Localizer", KnowsTheMotion)
    # Each frame stands alone: its motion is what it is.
    alone = Mock(side_effect=np.linalg.LinAlgError)
    monkeypatch.setattr(rs_localizer.tracking, "told_of", alone)


@pytest.fixture
def localize(
    make_cloud_message, make_camera_info
) -> Callable[..., tuple[Localized | Refusal, NodeConfig]]:
    fields = [(name, 8 * i, 8) for i, name in enumerate("xyzuv")]

    def run(
        transforms: Any, stamp: tuple[int, int] = (5, 0), roi: Any = None, **settings: Any
    ) -> tuple[Localized | Refusal, NodeConfig]:
        config = NodeConfig(
            **({"readout_time": READOUT_TIME, "base_frame": "base_link"} | settings)
        )
        frames = CameraFrames(config, transforms=transforms)
        frames.stream.zero_is_time = True
        frames.calibrate(
            read_camera_info(make_camera_info(**({} if roi is None else {"roi": roi})))
        )
        rows = [[1.0, 2.0, 3.0, 100.0, 200.0]] * 8
        return frames.localize(make_cloud_message(rows, fields, point_step=40, stamp=stamp)), config

    return run


def localized(result: tuple[Localized | Refusal, NodeConfig]) -> Localized:
    assert result[0], result[0]
    return result[0]


@pytest.mark.parametrize("direction", list(ScanDirection))
@pytest.mark.parametrize("pose_time", list(PoseTime))
def test_every_quantity(localize, robot, pose_time, direction):
    # Of a region of the sensor (x 40 to 359, y 100 to 399), the stamp is that of its first line.
    lines = {
        "top_to_bottom": (239.5 - 100) / 479,
        "bottom_to_top": (399 - 239.5) / 479,
        "left_to_right": (319.5 - 40) / 639,
        "right_to_left": (359 - 319.5) / 639,
    }[direction]
    truth = Chain(estimate(), middle=5.0 + 0.004 + READOUT_TIME * lines)
    # Odometry that has drifted: where it believes the robot at a time, from a motion of its own.
    drift = matrix([3.0, -1.0, 0.2], Rotation.from_rotvec([0.05, -0.02, 0.7]).as_matrix())
    for index in range(16):
        seconds = 4.99 + 0.0041 * index
        odom_from_base = np.linalg.inv(drift) @ truth.map_from_base(truth.motion, seconds)
        robot.add(tf("odom", "base_link", odom_from_base, seconds), static=False)
    settings = {
        "stamp_offset": 0.004,
        "scan_direction": direction,
        "pose_time": pose_time,
        "roi": SimpleNamespace(x_offset=40, y_offset=100, width=320, height=300),
    }
    result = localize(robot, **settings, publish_tf="map_to_odom")
    frame = localized(result)

    published = truth.middle if pose_time == PoseTime.MID_FRAME else 5.0
    assert abs(frame.stamp_ns - published * 1e9) <= 1.0
    published = frame.stamp_ns * 1e-9
    pose, twist = truth.map_from_base(truth.motion, published), truth.twist(truth.motion, published)
    assert frame.twist is not None
    assert np.allclose(frame.pose.position, pose[:3, 3], atol=1e-12)
    assert np.allclose(frame.pose.rotation, pose[:3, :3], atol=1e-12)
    assert np.allclose([*frame.twist.linear, *frame.twist.angular], twist, atol=2e-6)
    joint = estimate().joint_covariance
    expected = covariance_of(lambda error: truth.pose_error(published, error), joint, 1e-5)
    assert np.allclose(frame.pose.covariance, expected, rtol=1e-6, atol=1e-9)
    expected = covariance_of(lambda error: truth.twist_error(published, error), joint, 1e-3)
    assert np.allclose(frame.twist.covariance, expected, atol=1e-5 * np.abs(expected).max())

    # TF: the drift is what the localizer finds. Odometry between its samples is interpolated.
    correction, _ = broadcast(*result, robot, CorrectionState())
    assert (correction.parent, correction.child) == ("map", "odom")
    assert correction.stamp_ns == frame.stamp_ns + 200_000_000
    assert np.allclose(as_matrix(correction), drift, atol=2e-4)
    interpolated = robot.lookup("odom", "base_link", frame.stamp_ns)
    chain = as_matrix(correction) @ matrix(interpolated.translation, interpolated.rotation)
    assert np.allclose(chain, pose, atol=1e-12)
    frame, config = localize(robot, **settings, publish_tf="map_to_camera")
    direct, _ = broadcast(frame, config, robot, CorrectionState())
    assert (direct.parent, direct.child) == ("map", "base_link")
    assert direct.stamp_ns == frame.stamp_ns
    assert np.allclose(as_matrix(direct), pose, atol=1e-12)


def as_matrix(item: Broadcast) -> Array:
    return matrix(item.parent_from_child.translation, item.parent_from_child.rotation)


@pytest.mark.parametrize("pose_time", list(PoseTime))
def test_a_camera_on_a_moving_head(localize, robot, pose_time):
    truth = Panning(estimate(), middle=5.0 + 0.5 * READOUT_TIME)
    for index in range(-5, 30):
        seconds = 5.0 + 0.005 * index
        robot.add(tf("base_link", "mast", truth.base_from_mast(seconds), seconds), static=False)
    frame = localized(localize(robot, pose_time=pose_time))
    published = truth.middle if pose_time == PoseTime.MID_FRAME else 5.0
    pose, twist = truth.map_from_base(truth.motion, published), truth.twist(truth.motion, published)
    assert frame.twist is not None
    assert np.allclose(frame.pose.position, pose[:3, 3], atol=1e-9)
    assert np.allclose(frame.pose.rotation, pose[:3, :3], atol=1e-9)
    # The head's velocity is a difference over one readout: exact to second order in its turn.
    assert np.allclose([*frame.twist.linear, *frame.twist.angular], twist, atol=1e-4)
    still = Chain(estimate(), truth.middle).twist(truth.motion, published)
    assert np.abs(twist - still).max() > 0.1  # the head's turn does count
    # A time without samples on both sides has no velocity: better no frame than a wrong one.
    refused, _ = localize(robot, stamp=(5, 140_000_000))
    assert isinstance(refused, Refusal)
    assert refused.reason == "no_transform"
    assert "'mast' is known from 4.975 s to 5.145 s, not at 5.155 s" in refused.detail


def test_a_frame_waits_for_the_mounting_at_its_last_row():
    class Live(TransformTree):
        """Knows what a head that moves did until 5 s."""

        def lookup(self, target: str, source: str, stamp_ns: int | None) -> Any:
            raise (NotYetError if stamp_ns > STAMP_NS else TransformError)(source)

    frames = CameraFrames(NodeConfig(readout_time=0.03, base_frame="base_link"), transforms=Live())
    assert frames.patience(STAMP_NS - 29_000_000) == 0.0  # no camera_info has come
    frames.calibrate(ANY_CALIBRATION)
    assert frames.patience(STAMP_NS - 31_000_000) == 0.0
    assert frames.patience(STAMP_NS - 29_000_000) == frames.config.transform_tolerance


def test_a_missing_transform_refuses_the_frame_only(localize):
    tree = TransformTree()
    refused, _ = localize(tree)
    assert refused == Refusal(
        "no_transform",
        "from the camera 'camera' to base_frame 'base_link': "
        "frame 'camera' does not exist; there are none",
    )
    tree.add(tf("base_link", "mast", BASE_FROM_MAST), static=True)
    tree.add(tf("head", "camera", np.eye(4)), static=True)
    refused, _ = localize(tree)
    assert "'camera' and 'base_link' are not connected" in refused.detail
    # The next frame finds what has come meanwhile, and what has changed.
    for offset in (0.0, 0.5):
        tree.add(tf("mast", "head", matrix([offset, 0.0, 0.0], np.eye(3))), static=True)
        frame = localized(localize(tree))
        chain = Chain(estimate(), 5.0 + 0.5 * READOUT_TIME)
        chain.camera_from_base = lambda _, offset=offset: np.linalg.inv(
            BASE_FROM_MAST @ matrix([offset, 0.0, 0.0], np.eye(3))
        )
        expected = chain.map_from_base(estimate(), 5.0)
        assert np.allclose(frame.pose.position, expected[:3, 3], atol=1e-12)


@pytest.mark.parametrize("pose_time", list(PoseTime))
def test_a_stamp_of_zero_in_a_recording_that_starts_there(localize, robot, pose_time):
    # The mounting is the latest, the pose goes out, and TF, which needs a time, gets nothing.
    robot.add(tf("base_link", "mast", matrix([9.0, 0.0, 0.0], np.eye(3)), 7.0), static=False)
    robot.add(tf("base_link", "mast", BASE_FROM_MAST, 8.0), static=False)
    expected = localized(localize(robot, stamp=(8, 0), readout_time=0.0))
    settings = {"readout_time": 0.0, "pose_time": pose_time, "stamp_offset": -0.01}
    frame, config = localize(robot, stamp=(0, 0), publish_tf="map_to_camera", **settings)
    if pose_time == PoseTime.STAMP:
        assert np.allclose(frame.pose.position, expected.pose.position, atol=1e-12)
    assert frame.stamp_ns == (0 if pose_time == PoseTime.STAMP else -10_000_000)
    with pytest.raises(TransformError, match=r"header.stamp of the input is zero"):
        broadcast(frame, config, robot, CorrectionState())
