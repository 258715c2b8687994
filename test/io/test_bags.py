# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of ROS 2 and their frames: what is written is read; the rest is refused by name.

That a bag of ROS 1 gives the same, test/cli/test_replay.py says.
"""

import contextlib
import sqlite3
from pathlib import Path
from types import SimpleNamespace as Made
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.io.bags import BagError, BagWriter, is_bag, make_message, open_bag
from rs_localizer.io.messages import make_header
from rs_localizer.io.transforms import TransformError, TransformTree


def point(seconds: int, x: float) -> Any:
    return make_message(
        "geometry_msgs/msg/PointStamped",
        header=make_header(make_message, seconds * 10**9 + 7, "map"),
        point=make_message("geometry_msgs/msg/Point", x=x, y=0.25, z=-1e-300),
    )


def write_ros2(path: Path, storage: StoragePlugin = StoragePlugin.MCAP) -> None:
    with BagWriter(path, storage) as bag:
        bag.write("/points", point(3, 3.0), 3_000_000_007)
        bag.write("/points", point(1, 1.0), 1_000_000_007)
        bag.write("/other", point(2, 2.0), 2_000_000_007)


@pytest.mark.parametrize("storage", StoragePlugin)
def test_ros2_round_trip_in_order_of_time(tmp_path, storage):
    write_ros2(tmp_path / "bag", storage)
    (data,) = (file for file in (tmp_path / "bag").iterdir() if file.name != "metadata.yaml")
    for path in (tmp_path / "bag", data):
        with open_bag(path) as bag:
            assert bag.topics == dict.fromkeys(
                ("/points", "/other"), "geometry_msgs/msg/PointStamped"
            )
            assert bag.count(["/points", "/other", "/absent"]) == 3
            read = list(bag.messages(["/points", "/other"]))
        assert [(topic, stamp) for topic, stamp, _ in read] == [
            ("/points", 1_000_000_007),
            ("/other", 2_000_000_007),
            ("/points", 3_000_000_007),
        ]
        assert repr(read[2][2]) == repr(point(3, 3.0))


def test_killed_recorder_left_no_metadata(tmp_path):
    write_ros2(tmp_path / "bag")
    metadata = tmp_path / "bag" / "metadata.yaml"
    for leave in (lambda: metadata.write_text(""), metadata.unlink):
        leave()
        with open_bag(tmp_path / "bag") as bag:
            assert bag.count(["/points"]) == 2


def test_what_was_written_before_an_error_stays_readable(tmp_path):
    bag = BagWriter(tmp_path / "bag").__enter__()
    bag.write("/points", point(1, 1.0), 1)
    bag.__exit__(KeyboardInterrupt, KeyboardInterrupt(), None)
    with open_bag(tmp_path / "bag") as bag:
        assert bag.count(["/points"]) == 1


def test_nothing_is_overwritten(tmp_path):
    write_ros2(tmp_path / "bag")
    with pytest.raises(BagError, match=r"bag exists already"):
        BagWriter(tmp_path / "bag")


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("absent", None, "absent does not exist"),
        ("notes.txt", b"hello", r"notes.txt is not a recording: expected a rosbag2 folder, or a"),
        ("zero.mcap", b"", "zero.mcap.* seems to be empty"),
        ("wrong.mcap", b"hello" * 99, "wrong.mcap cannot be read as a recording"),
        ("short.mcap", b"\x89MCAP0\r\n", "short.mcap cannot be read as a recording"),
    ],
)
def test_what_is_no_recording_is_refused(tmp_path, name, content, expected):
    if content is not None:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(BagError, match=expected), open_bag(tmp_path / name):
        pass


def cut(bag: Path, share: float) -> Path:
    """The file of a recording, of which the end is missing."""
    (data,) = (file for file in bag.iterdir() if file.name != "metadata.yaml")
    content = data.read_bytes()
    data.write_bytes(content[: int(share * len(content))])
    return data


def test_a_truncated_database(tmp_path):
    with BagWriter(tmp_path / "bag", StoragePlugin.SQLITE3) as bag:
        for index in range(500):
            bag.write("/points", point(index, 1.0), index)
    cut(tmp_path / "bag", 0.6)
    with pytest.raises(BagError, match="bag cannot be read"), open_bag(tmp_path / "bag") as opened:
        list(opened.messages(["/points"]))


def test_a_truncated_mcap_is_sent_to_who_mends_it(tmp_path):
    write_ros2(tmp_path / "bag")
    data = cut(tmp_path / "bag", 0.7)
    for path in (tmp_path / "bag", data):  # with its metadata, and without
        with pytest.raises(BagError, match=r"is cut off: mcap recover bag"), open_bag(path):
            pass


def test_parts_of_a_split_recording(tmp_path):
    """Without metadata; the tenth after the ninth."""
    (tmp_path / "bag").mkdir()
    for part in range(11):
        with BagWriter(tmp_path / f"part{part}") as bag:
            bag.write("/points", point(part, float(part)), part)
        (data,) = (file for file in (tmp_path / f"part{part}").glob("*.mcap"))
        data.rename(tmp_path / "bag" / f"rec_{part}.mcap")
    (tmp_path / "bag" / "0001.jpg").write_bytes(b"none")
    with open_bag(tmp_path / "bag") as bag:
        assert [stamp for _, stamp, _ in bag.messages(["/points"])] == list(range(11))


def test_databases_of_others_are_no_recordings(tmp_path):
    with contextlib.closing(sqlite3.connect(tmp_path / "database.db")) as tables:
        tables.execute("CREATE TABLE images (id)")
        tables.commit()
    assert not is_bag(tmp_path / "database.db")
    assert not is_bag(tmp_path)


Numbers = tuple[float, ...]
NAN = float("nan")
HALF_TURN = (0.0, 0.0, 1.0, 0.0)
NO_TURN = (0.0, 0.0, 0.0, 1.0)


def tf(parent: str, child: str, t: Numbers, q: Numbers, stamp_ns: int = 0) -> Made:
    place, turn = (Made(**dict(zip("xyzw", values, strict=False))) for values in (t, q))
    header = make_header(lambda _, **fields: Made(**fields), stamp_ns, parent)
    transform = Made(translation=place, rotation=turn)
    return Made(transforms=[Made(header=header, child_frame_id=child, transform=transform)])


# Parent, translation and quaternion of each frame; of the base, at two times.
STATIC = {
    "mast": ("base", (0.4, 0.3, 0.9), (0.1, -0.2, 0.3, 0.927361849549570)),
    "camera": ("mast", (0.0, 0.1, 0.25), (-0.5, 0.5, -0.5, 0.5)),
    "/lidar": ("/base", (-0.2, 0.0, 1.3), (0.9, 0.1, -0.4, -0.141421356237309)),
}
LAST_NS = 1_033_333_333
ODOMETRY = {
    LAST_NS: ((1.1, 2.1, 0.1), (0.0, 0.1, -0.6, -0.793725393319377)),
    10**9: ((1.0, 2.0, 0.1), (0.0, 0.0, 0.6, 0.8)),
}


@pytest.fixture
def tree() -> TransformTree:
    tree = TransformTree()
    for child, (parent, t, q) in STATIC.items():
        tree.add(tf(parent, child, t, q), static=True)
    for stamp_ns, (t, q) in ODOMETRY.items():
        tree.add(tf("odom", "base", t, q, stamp_ns), static=False)
    return tree


def matrix(t: Numbers, q: Numbers) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = Rotation.from_quat(q).as_matrix(), t
    return found


@pytest.mark.parametrize("target", ["odom", "base", "camera", "lidar"])
@pytest.mark.parametrize("stamp_ns", [None, 10**9, 1_012_345_678])
def test_chains_are_products_of_matrices_in_both_directions(tree, target, stamp_ns):
    """What tf2 itself says of such chains, test/real_ros compares."""
    times = sorted(ODOMETRY)
    places, turns = (np.array([ODOMETRY[time][k] for time in times]) for k in (0, 1))
    now = LAST_NS if stamp_ns is None else stamp_ns
    share = (now - times[0]) / (times[1] - times[0])
    turn = Slerp([0.0, 1.0], Rotation.from_quat(turns))(share).as_quat()
    in_odom = {"odom": np.eye(4)}
    in_odom["base"] = matrix((1.0 - share) * places[0] + share * places[1], turn)
    for child, (parent, t, q) in STATIC.items():
        in_odom[child.strip("/")] = in_odom[parent.strip("/")] @ matrix(t, q)
    for source, placed in in_odom.items():
        expected = np.linalg.inv(in_odom[target]) @ placed
        found = tree.lookup(target, source, stamp_ns)
        np.testing.assert_allclose(found.rotation, expected[:3, :3], atol=1e-14)
        np.testing.assert_allclose(found.translation, expected[:3, 3], atol=1e-14)


def test_what_moves(tree):
    assert not tree.moves("base", "camera")
    assert not tree.moves("lidar", "camera")  # through the base, which moves with both
    assert tree.moves("odom", "camera")
    assert not tree.moves("camera", "camera")
    # Static by the last word on it.
    tree.add(tf("odom", "base", (0.0, 0.0, 0.0), NO_TURN), static=True)
    assert not tree.moves("odom", "camera")
    assert tree.lookup("odom", "base", 5).translation.tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("target", "source", "stamp_ns", "text"),
    [
        ("nowhere", "camera", None, "frame 'nowhere' does not exist; there are base, camera, isl"),
        ("island", "camera", None, "'island' and 'camera' are not connected"),
        ("odom", "camera", 2 * 10**9, "is known from 1.000 s to 1.033 s, not at 2.000 s"),
        ("island", "palm", 6 * 10**9, "frame 'palm' is known from 5.000 s to 5.000 s, not at 6"),
    ],
)
def test_what_cannot_be_answered(tree, target, source, stamp_ns, text):
    tree.add(tf("island", "palm", (0.0, 0.0, 3.0), NO_TURN, 5 * 10**9), static=False)
    with pytest.raises(TransformError, match=text):
        tree.lookup(target, source, stamp_ns)


def test_a_frame_that_changes_its_parent(tree):
    for stamp, parent in enumerate(("camera", "camera", "lidar", "lidar")):
        shift = (float(stamp), 0.0, 0.0)
        tree.add(tf(parent, "cup", shift, NO_TURN, (stamp + 1) * 10**9), static=False)
    assert tree.lookup("camera", "cup", 1_500_000_000).translation.tolist() == [0.5, 0.0, 0.0]
    # Between two parents it stays with the older one, where it was.
    assert tree.lookup("camera", "cup", 2_500_000_000).translation.tolist() == [1.0, 0.0, 0.0]
    assert tree.lookup("lidar", "cup", None).translation.tolist() == [3.0, 0.0, 0.0]


def test_loops_end():
    tree = TransformTree()
    for parent, child in (("a", "b"), ("b", "c"), ("c", "a")):
        tree.add(tf(parent, child, (1.0, 0.0, 0.0), NO_TURN), static=True)
    tree.add(tf("d", "e", (0.0, 0.0, 0.0), NO_TURN), static=True)
    for stamp_ns in (None, 5):
        with pytest.raises(TransformError, match="loop"):
            tree.lookup("e", "a", stamp_ns)


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        (tf("a", "b", (NAN, 0.0, 0.0), NO_TURN), r"not exist.*'b' in 'a' on TF the tr.*not finite"),
        (tf("a", "/b", (0.0, 0.0, 0.0), (0.0,) * 4), r"not exist.* the quat.* is not a rotation"),
        (tf("a", "b", (0.0, 0.0, 0.0), (NAN,) * 4), r"not exist.* \(nan, nan, .* is not a rot"),
        (tf("a", "b", (0.0, 0.0, 0.0), (0.0, 0.0, 0.1, 1.1)), "not exist.* is not a rotation"),
        (tf("", "b", (0.0, 0.0, 0.0), NO_TURN), "does not exist; there are none"),
        (tf("b", "/b", (0.0, 0.0, 0.0), NO_TURN), "does not exist; there are none"),
    ],
)
def test_garbage_is_left_out(wrong, text):
    tree = TransformTree()
    tree.add(wrong, static=True)
    with pytest.raises(TransformError, match=text):
        tree.lookup("a", "b", None)
    tree.add(tf("a", "b", (0.0, 0.0, 1.0), HALF_TURN), static=True)
    tree.add(wrong, static=True)
    assert tree.lookup("a", "b", None).translation.tolist() == [0.0, 0.0, 1.0]


def test_a_gap_of_garbage_between_frames_is_named():
    tree = TransformTree()
    tree.add(tf("map", "odom", (0.0, 0.0, 0.0), NO_TURN), static=True)
    tree.add(tf("odom", "base", (0.0, 0.0, 0.0), (0.0,) * 4, 10**9), static=False)
    tree.add(tf("base", "camera", (0.0, 0.0, 0.0), NO_TURN), static=True)
    with pytest.raises(TransformError, match="not connected; of 'base' in 'odom' on TF the quat"):
        tree.lookup("map", "camera", None)
    tree.add(tf("odom", "base", (0.0, 0.0, 0.0), NO_TURN, 2 * 10**9), static=False)
    assert tree.lookup("map", "camera", None).translation.tolist() == [0.0, 0.0, 0.0]
    with pytest.raises(TransformError, match="'no' does not exist; there are base, camera, map, o"):
        tree.lookup("map", "no", None)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, 3.0, np.pi - 1e-7])
def test_between_two_samples_it_turns_evenly(angle):
    rng = np.random.default_rng(0)
    for _ in range(20):
        axis = rng.normal(size=3)
        older = Rotation.random(random_state=rng.integers(1000))
        newer = older * Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        tree = TransformTree()
        for stamp_ns, rotation in ((10, older), (110, newer)):
            tree.add(
                tf("odom", "base", (0.0, 0.0, 0.0), rotation.as_quat(), stamp_ns), static=False
            )
        both = Rotation.concatenate([older, newer])
        expected = Slerp([10.0, 110.0], both)(40.0).as_matrix()
        found = tree.lookup("odom", "base", 40).rotation
        np.testing.assert_allclose(found, expected, atol=1e-12 + 1e-8 * (angle > 3.1))
