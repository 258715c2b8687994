# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The six messages of a frame: values, frames and stamps, and what is left out without a twist."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.io.bags import make_message, typestore
from rs_localizer.io.outputs import TYPES, BodyPose, Localized, Twist, messages


@pytest.fixture
def frame() -> Localized:
    rng = np.random.default_rng(1)
    rows = np.zeros(3, [(name, "<f4") for name in ("x", "y", "z", "u", "v", "residual")])
    pose = BodyPose(rng.normal(size=3), so3.exp(rng.normal(size=3)), rng.normal(size=(6, 6)))
    twist = Twist(rng.normal(size=3), rng.normal(size=3), rng.normal(size=(6, 6)))
    # The stamp is half a readout before one of 0.
    estimate = SimpleNamespace(twist_known=True)
    return Localized(1_999_999_999, -1, "hall", "left_eye", pose, twist, rows, 0, estimate)


def vector(message: Any) -> list[float]:
    return [message.x, message.y, message.z]


def test_types_and_headers(frame):
    made = messages(frame, make_message)
    assert {name: message.__msgtype__ for name, message in made.items()} == TYPES
    for name, message in made.items():
        stamp = (message.header.stamp.sec, message.header.stamp.nanosec)
        # Inliers are rows of the input: they keep its stamp.
        assert stamp == ((1, 999_999_999) if name == "inliers" else (-1, 999_999_999))
        assert message.header.frame_id == ("left_eye" if name.startswith("twist") else "hall")
    assert made["odometry"].child_frame_id == "left_eye"
    for message in made.values():
        typestore().serialize_cdr(message, message.__msgtype__)


def test_values(frame):
    made = messages(frame, make_message)
    odometry = made["odometry"]
    for pose in (made["pose"].pose, made["pose_with_covariance"].pose.pose, odometry.pose.pose):
        assert vector(pose.position) == frame.pose.position.tolist()
        turned = Rotation.from_quat([*vector(pose.orientation), pose.orientation.w])
        np.testing.assert_allclose(turned.as_matrix(), frame.pose.rotation, atol=1e-14)
    twists = (made["twist"].twist, made["twist_with_covariance"].twist.twist, odometry.twist.twist)
    for twist in twists:
        assert vector(twist.linear) == frame.twist.linear.tolist()
        assert vector(twist.angular) == frame.twist.angular.tolist()
    for message in (made["pose_with_covariance"].pose, odometry.pose):
        assert np.array_equal(message.covariance.reshape(6, 6), frame.pose.covariance)
    for message in (made["twist_with_covariance"].twist, odometry.twist):
        assert np.array_equal(message.covariance.reshape(6, 6), frame.twist.covariance)


def test_a_pose_without_a_covariance_says_so(frame):
    """As frames have whose samples nothing refines."""
    none = dataclasses.replace(frame.pose, covariance=np.full((6, 6), np.nan))
    made = messages(dataclasses.replace(frame, pose=none), make_message)
    for message in (made["pose_with_covariance"], made["odometry"]):
        assert np.array_equal(message.pose.covariance.reshape(6, 6), -np.eye(6))


def test_without_a_twist_nothing_claims_one(frame):
    made = messages(dataclasses.replace(frame, twist=None), make_message)
    assert set(made) == {"pose", "pose_with_covariance", "inliers"}


def test_an_unknown_twist_is_not_sent_or_says_so(frame):
    """A mean of rest and motion would be taken for a camera that hardly moves."""
    unknown = dataclasses.replace(frame, estimate=SimpleNamespace(twist_known=False))
    assert unknown.known_twist is None
    made = messages(unknown, make_message)
    assert set(made) == set(TYPES) - {"twist"}
    for message in (made["twist_with_covariance"].twist, made["odometry"].twist):
        assert vector(message.twist.linear) == vector(message.twist.angular) == [0.0, 0.0, 0.0]
        assert np.array_equal(message.covariance.reshape(6, 6), 1e6 * np.eye(6))
    assert np.array_equal(made["odometry"].pose.covariance.reshape(6, 6), frame.pose.covariance)
