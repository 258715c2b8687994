# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Trajectory files keep every bit, times above all; faults are named with their line."""

import numpy as np
import pytest

from rs_localizer.io.bags import BagError, BagWriter
from rs_localizer.io.messages import make_header, make_vector
from rs_localizer.io.trajectories import (
    Trajectory,
    TrajectoryError,
    format_stamp,
    parse_stamp,
    read_motions,
    read_tum,
    split_at_gaps,
    write_tum,
)

POSE = "0.1 0.2 0.3 0 0 0 1"


def trajectory(stamps_ns: list[int]) -> Trajectory:
    rng = np.random.default_rng(1)
    quaternions = rng.normal(size=(len(stamps_ns), 4))
    quaternions /= np.linalg.norm(quaternions, axis=1, keepdims=True)
    return Trajectory(np.array(stamps_ns), rng.normal(size=(len(stamps_ns), 3)), quaternions)


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
    assert parse_stamp(text) == stamp_ns
    assert parse_stamp(format_stamp(stamp_ns)) == stamp_ns


@pytest.mark.parametrize("name", ["poses.txt", "poses.txt.gz"])
def test_poses_round_trip(tmp_path, name):
    written = trajectory([-5, 0, 1, 1_520_531_467_575_280_001, 1_520_531_467_575_280_002])
    write_tum(tmp_path / name, written)
    read = read_tum(tmp_path / name)
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
    with pytest.raises(TrajectoryError, match=expected):
        read_tum(tmp_path / "a.txt")


def test_truths_in_any_order_and_with_gaps(tmp_path):
    lost = "nan NaN nan nan nan nan nan"
    (tmp_path / "a.txt").write_text(f"3 {POSE}\n2 {lost}\n1 {POSE}\n3 {POSE}\n")
    assert read_tum(tmp_path / "a.txt").stamps_ns.tolist() == [10**9, 3 * 10**9]
    (tmp_path / "a.csv").write_text(f"1.5,{POSE.replace(' ', ',')}\n")  # TUM with commas
    np.testing.assert_array_equal(read_tum(tmp_path / "a.csv").quaternions, [[0, 0, 0, 1]])


def test_split_only_at_gaps():
    # Spacing 10: a pause of 30 is not longer than three spacings, one of 31 is.
    parts = split_at_gaps(trajectory([0, 10, 20, 50, 60, 70, 101, 111, 121, 500]))
    assert [part.stamps_ns.tolist() for part in parts] == [
        [0, 10, 20, 50, 60, 70],
        [101, 111, 121],
        [500],
    ]
    assert [len(part) for part in split_at_gaps(trajectory([7]))] == [1]


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
        read_motions(tmp_path / "bag")
    with pytest.raises(BagError, match=r"/twist is of type .*Twist.*: /other, /pose"):
        read_motions(tmp_path / "bag", "/twist")
    found = read_motions(tmp_path / "bag", "/pose")
    assert found.poses.stamps_ns.tolist() == [10**9, 2 * 10**9, 3 * 10**9]
    assert found.poses.positions[0].tolist() == [1.0, 2.0, 4.0]
    assert found.poses.quaternions[0].tolist() == [0.0, 0.0, 0.6, 0.8]
    assert found.twists is not None
    assert found.twists.angular[0].tolist() == [0.0, 0.0, 0.1]
    assert found.twists.linear[2].tolist() == [3.0, 0.0, 1.0]


def test_poses_of_a_file_and_of_a_recording_of_anything_else(tmp_path):
    file = tmp_path / "poses.txt"
    file.write_text(f"1 {POSE}\n2 {POSE}\n")
    assert read_motions(file).twists is None
    (tmp_path / "twists.txt").write_text("# nothing\n")
    found = read_motions(tmp_path)
    assert len(found.poses.stamps_ns) == 2
    assert found.twists is None
    with BagWriter(tmp_path / "bag") as bag:
        bag.write("/twist", stamped("TwistStamped", 1, [0, 0, 0], [0, 0, 0]), 0)
    with pytest.raises(BagError, match=r"no topic of type .*PoseStamped for .*; it has /twist"):
        read_motions(tmp_path / "bag")
