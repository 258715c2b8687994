# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of ROS 2 are written and read back; bad ones are refused by name.

That a bag of ROS 1 gives the same, test/cli/test_replay.py says.
"""

import contextlib
import sqlite3
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag2 import StoragePlugin

from rs_localizer.io.bags import BagError, BagWriter, is_bag, make_message, open_bag
from rs_localizer.io.messages import make_header


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
