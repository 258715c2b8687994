# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The table of frames: one row a frame, the same bytes whoever makes it."""

import pickle
import subprocess
import sys
from pathlib import Path

import pytest

pytest.importorskip(  # of today, which NumPy 1.26 cannot import
    "pyarrow", reason="needs pyarrow (rs_localizer[table])", exc_type=ImportError
)

from pyarrow.parquet import read_table

import rs_localizer as rsl
from rs_localizer.cli.commands import main
from rs_localizer.config import NodeConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.trajectories import read_tum
from rs_localizer.offline import frame_table
from rs_localizer.offline.frame_table import COLUMNS, schema
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.refusal import Refusal

SETTINGS = {"readout_time": 0.03}
SHUTTER = ["-p", "readout_time:=0.03"]
MOVING = ("--angular-velocity", "0.4", "1", "-0.3", "--linear-velocity", "0.5", "0.2", "0.3")


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Three recordings; the first one has a frame that is refused, and a message that is none."""
    folder = tmp_path_factory.mktemp("flights")
    made = []
    for number in range(3):
        path = folder / f"flight_{number}"
        words = ["--duration", "0.3", "--points", "100", "--seed", str(number), *MOVING]
        assert main(["simulate", str(path), *words, "--readout-time", "0.03"]) == 0
        made.append(path)
    with open_bag(made[0]) as bag:
        messages = list(bag.messages(["/camera_info", "/correspondences"]))
    with BagWriter(folder / "changed") as writer:
        for topic, stamp_ns, message in messages:
            if topic == "/correspondences" and stamp_ns == messages[-1][1]:
                keep = 4 * message.point_step
                message.width, message.row_step, message.data = 4, keep, message.data[:keep]
            writer.write(topic, message, stamp_ns)
    made[0] = folder / "changed"
    return made


def test_rows_say_what_the_messages_say(flights: list[Path], tmp_path: Path) -> None:
    file = tmp_path / "out" / "frames.parquet"
    words = [str(flights[0]), *SHUTTER, "--out", str(tmp_path / "out"), "--parquet", str(file)]
    assert main(["replay", *words]) == 0
    assert main(["replay", *words, "--overwrite"]) == 0
    table = read_table(file)
    assert table.schema == schema()
    assert table.column_names == list(COLUMNS)
    rows = table.to_pylist()
    assert {row["recording"] for row in rows} == {str(flights[0])}
    assert [row["state"] for row in rows] == ["localized"] * (len(rows) - 1) + ["refused"]
    assert rows[-1]["reason"] == "too_few_points"
    assert rows[-1]["x"] is rows[-1]["pose_covariance"] is rows[-1]["points"] is None
    with open_bag(tmp_path / "out" / "result") as bag:
        said = {name: [m for _, _, m in bag.messages([f"/rs_localizer/{name}"])] for name in TYPES}
    assert len(said["odometry"]) == len(rows) - 1
    assert len(said["twist"]) == sum(row["wx"] is not None for row in rows) > 0
    poses = read_tum(tmp_path / "out" / "poses.txt")
    for row, stamp, message, inliers in zip(
        rows, poses.stamps_ns, said["odometry"], said["inliers"], strict=False
    ):
        assert row["stamp_ns"] == row["pose_stamp_ns"] == stamp
        pose, twist = message.pose.pose, message.twist.twist
        for vector, names in (
            (pose.position, ("x", "y", "z")),
            (pose.orientation, ("qx", "qy", "qz", "qw")),
            (twist.angular, ("wx", "wy", "wz")),
            (twist.linear, ("vx", "vy", "vz")),
        ):
            if row["wx"] is not None or vector in (pose.position, pose.orientation):
                assert [row[name] for name in names] == [getattr(vector, n[-1]) for n in names]
        assert row["pose_covariance"] == list(message.pose.covariance)
        known = None if row["wx"] is None else list(message.twist.covariance)
        assert row["twist_covariance"] == known
        assert (known is None) == (message.twist.covariance[0] == 1e6)
        assert row["inliers"] == inliers.width
        assert (row["points"], row["map_frame"]) == (100, "map")


_ALONE = """
import pickle, sys
import rs_localizer as rsl
from rs_localizer.offline.frame_table import write_parquet
function, places, settings, file = pickle.load(sys.stdin.buffer)
write_parquet((function(place, None, settings) for place in places), file)
"""


def test_the_same_bytes_from_one_process_and_from_two(flights: list[Path], tmp_path: Path) -> None:
    one, two = tmp_path / "one.parquet", tmp_path / "two.parquet"
    given = pickle.dumps((rsl.localize_recording, flights, SETTINGS, one))
    words = [*map(str, flights), "--out", str(tmp_path / "out"), "--parquet", str(two), *SHUTTER]
    command = [sys.executable, "-m", "rs_localizer", "replay", *words, "--workers", "2"]
    for called, standard_input in (([sys.executable, "-c", _ALONE], given), (command, None)):
        done = subprocess.run(called, input=standard_input, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr
    assert one.read_bytes().startswith(b"PAR1")
    assert read_table(one).num_rows > 3 * 5
    assert two.read_bytes() == one.read_bytes()


@pytest.mark.parametrize("count", [6, 7])
def test_each_row_is_in_the_table_once_however_many_there_are(monkeypatch, count):
    monkeypatch.setattr(frame_table, "_ROWS", 3)  # at a time, of a thousand
    table = frame_table.FrameTable("flight", CameraFrames(NodeConfig()))
    for stamp_ns in range(count, 0, -1):
        table.add(stamp_ns, Refusal(Reason.TOO_FEW_POINTS, "none"))
    assert table.table()["stamp_ns"].to_pylist() == list(range(1, count + 1))
