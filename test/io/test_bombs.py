# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Small files that stand for much work or memory, or lie about it: one sentence, at once."""

import gzip
import shutil
import sqlite3
import struct
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag2 import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from rs_localizer.io.bags import BagError, open_bag
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.maps.landmarks import MapError
from rs_localizer.io.trajectories import TrajectoryError, read_tum
from rs_localizer.io.video import Video, VideoError

COLMAP = Path(__file__).parent / "maps" / "colmap"
IMU = "sensor_msgs/msg/Imu"
POSE = b"1 0 0 0 0 0 0 1\n"


@pytest.fixture(autouse=True)
def in_time() -> Iterator[None]:
    started = time.process_time()
    yield
    assert time.process_time() - started < 20.0


def test_a_stream_of_images_that_claim_too_much(tmp_path):
    size = b"\x00\x11\x08" + struct.pack(">HH", 65000, 65000) + b"\x03" + bytes(9)
    image = b"\xff\xd8\xff\xc0" + size + b"\xff\xda\x00\x02" + bytes(20) + b"\xff\xd9"
    (tmp_path / "a.mjpeg").write_bytes(image * 3)
    with pytest.raises(VideoError, match=r"no (image|stream of images) that can be"):
        list(Video(tmp_path / "a.mjpeg"))


@pytest.mark.parametrize("text", [bytes(50_000_000), b"1" * 50_000_000, POSE + b"# " * 10**7])
def test_packed_text(tmp_path, text):
    (tmp_path / "a.gz").write_bytes(gzip.compress(text, 1))
    with pytest.raises(TrajectoryError, match="at most 10000 characters"):
        read_tum(tmp_path / "a.gz")


def test_a_view_in_the_place_of_descriptors(tmp_path):
    shutil.copytree(COLMAP / "binary", tmp_path / "model")
    endless = (
        "CREATE VIEW descriptors AS WITH RECURSIVE n(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM n)"
        " SELECT x AS image_id, 0 AS type, 1 AS rows, 128 AS cols, x AS data FROM n WHERE x < 0"
    )
    with sqlite3.connect(tmp_path / "model" / "database.db") as tables:
        tables.execute(endless)
    tables.close()
    with pytest.raises(MapError, match="of 0 kinds"):
        read_map_file(tmp_path / "model", "map")


def test_recordings_with_types_of_their_own(tmp_path):
    own = get_typestore(Stores.EMPTY)
    own.register(get_types_from_msg("float64[] angular_velocity_covariance\n", IMU))
    with Writer(tmp_path / "bag", version=9) as writer:
        connection = writer.add_connection("/imu", IMU, typestore=own)
        message = own.types[IMU](angular_velocity_covariance=np.zeros(2))
        writer.write(connection, 1, own.serialize_cdr(message, IMU))
    with (
        open_bag(tmp_path / "bag") as bag,
        pytest.raises(BagError, match="describes sensor_msgs/msg/Imu otherwise than ROS 2"),
    ):
        list(bag.messages(["/imu"]))
