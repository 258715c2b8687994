# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What goes out and comes back: messages of results, trajectories in TUM's format, twists."""

import dataclasses
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.io import trajectories
from rs_localizer.io.bags import BagError, BagWriter, make_message, typestore
from rs_localizer.io.messages import make_header, make_vector
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


POSE = "0.1 0.2 0.3 0 0 0 1"


def trajectory(stamps_ns: list[int]) -> trajectories.Trajectory:
    rng = np.random.default_rng(1)
    quaternions = rng.normal(size=(len(stamps_ns), 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return trajectories.Trajectory(
        np.array(stamps_ns), rng.normal(size=(len(stamps_ns), 3)), quaternions
    )


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1520531467.575280001", 1_520_531_467_575_280_001),
        ("1520531467.57528", 1_520_531_467_575_280_000),
        ("1.520531467575280064e+09", 1_520_531_467_575_280_064),
        ("0", 0),
        ("-0.000000001", -1),
        ("12.0000000004", 12_000_000_000),
    ],
)
def test_stamps_are_exact(text, stamp_ns):
    assert trajectories.parse_stamp(text) == stamp_ns
    assert trajectories.parse_stamp(trajectories.format_stamp(stamp_ns)) == stamp_ns


@pytest.mark.parametrize("name", ["poses.txt", "poses.txt.gz"])
def test_poses_round_trip(tmp_path, name):
    written = trajectory([-5, 0, 1, 1_520_531_467_575_280_001, 1_520_531_467_575_280_002])
    trajectories.write_tum(tmp_path / name, written)
    read = trajectories.read_tum(tmp_path / name)
    np.testing.assert_array_equal(read.stamps_ns, written.stamps_ns)
    np.testing.assert_array_equal(read.positions, written.positions)
    np.testing.assert_allclose(read.quaternions, written.quaternions, rtol=0, atol=1e-15)
    assert ((tmp_path / name).read_bytes()[:2] == b"\x1f\x8b") == name.endswith(".gz")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"1 {POSE}\n2 {POSE} 9\n", r"line 2: expected .* t x y z qx qy qz qw, found '2 0.1"),
        ("1 nan 0 0 0 0 0 1\n", r"line 1: .*finite.* found '1 nan"),
        (f"1.5 {POSE}\n1.5 1{POSE}\n", r"the time 1.5 is there twice, with different"),
        ("1 0 0 0 0 0 0 0.5\n", r"the quaternion of pose 1 has norm 0.5, not 1"),
        ("# only a title\n", r"a.txt holds no line of numbers"),
    ],
)
def test_faults_are_named(tmp_path, text, expected):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(trajectories.TrajectoryError, match=expected):
        trajectories.read_tum(tmp_path / "a.txt")


def test_truths_in_any_order_and_with_gaps(tmp_path):
    lost = "nan NaN nan nan nan nan nan"
    (tmp_path / "a.txt").write_text(f"3 {POSE}\n2 {lost}\n1 {POSE}\n3 {POSE}\n")
    assert trajectories.read_tum(tmp_path / "a.txt").stamps_ns.tolist() == [10**9, 3 * 10**9]
    (tmp_path / "a.csv").write_text(f"1.5,{POSE.replace(' ', ',')}\n")  # TUM with commas
    np.testing.assert_array_equal(
        trajectories.read_tum(tmp_path / "a.csv").quaternions, [[0, 0, 0, 1]]
    )


def test_split_only_at_gaps():
    # Spacing 10: a pause of 30 is not longer than three spacings, one of 31 is.
    parts = trajectories.split_at_gaps(trajectory([0, 10, 20, 50, 60, 70, 101, 111, 121, 500]))
    assert [part.stamps_ns.tolist() for part in parts] == [
        [0, 10, 20, 50, 60, 70],
        [101, 111, 121],
        [500],
    ]
    assert [len(part) for part in trajectories.split_at_gaps(trajectory([7]))] == [1]


def stamped(kind: str, seconds: int, first: list[float], second: list[float]):
    """PoseStamped or TwistStamped of position and quaternion, or of rates and velocity."""
    make = BagWriter.make
    if kind == "TwistStamped":
        angular, linear = (make_vector(make, np.array(each, float)) for each in (first, second))
        parts = {"twist": make("geometry_msgs/msg/Twist", angular=angular, linear=linear)}
    else:
        point = make_vector(make, np.array(first, float), "Point")
        turn = make("geometry_msgs/msg/Quaternion", **dict(zip("xyzw", second, strict=True)))
        parts = {"pose": make("geometry_msgs/msg/Pose", position=point, orientation=turn)}
    header = make_header(make, seconds * 10**9, "map")
    return make(f"geometry_msgs/msg/{kind}", header=header, **parts)


def test_poses_and_twists_of_a_recording(tmp_path):
    poses = [(3, [3.0, 0.0, 1.0]), (1, [1.0, 2.0, 4.0]), (2, [2.0, 1.0, 0.0])]
    with BagWriter(tmp_path / "bag") as bag:
        for seconds, position in poses:
            bag.write("/pose", stamped("PoseStamped", seconds, position, [0, 0, 0.6, 0.8]), 0)
            bag.write("/twist", stamped("TwistStamped", seconds, [0, 0, 0.1], position), 0)
        bag.write("/other", stamped("PoseStamped", 9, [0, 0, 0], [0, 0, 0, 1]), 0)
    with pytest.raises(BagError, match=r"several .*PoseStamped: /other, /pose; .* -r pose:=TOPIC"):
        trajectories.read_motions(tmp_path / "bag")
    with pytest.raises(BagError, match=r"/twist is of type .*Twist.*: /other, /pose"):
        trajectories.read_motions(tmp_path / "bag", "/twist")
    found = trajectories.read_motions(tmp_path / "bag", "/pose")
    assert found.poses.stamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    assert found.poses.positions[0].tolist() == [1.0, 2.0, 4.0]
    assert found.poses.quaternions[0].tolist() == [0.0, 0.0, 0.6, 0.8]
    assert found.twists is not None
    assert found.twists.angular[0].tolist() == [0.0, 0.0, 0.1]
    assert found.twists.linear[2].tolist() == [3.0, 0.0, 1.0]


def test_poses_of_a_file_and_of_a_recording_of_anything_else(tmp_path):
    file = tmp_path / "poses.txt"
    file.write_text(f"1 {POSE}\n2 {POSE}\n")
    assert trajectories.read_motions(file).twists is None
    (tmp_path / "twists.txt").write_text("# nothing\n")
    found = trajectories.read_motions(tmp_path)
    assert len(found.poses.stamps_ns) == 2
    assert found.twists is None
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/twist", stamped("TwistStamped", 1, [0, 0, 0], [0, 0, 0]), 0)
    with pytest.raises(BagError, match=r"no topic of type .*PoseStamped for .*; it has /twist"):
        trajectories.read_motions(tmp_path / "bag")
