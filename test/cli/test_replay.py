# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay``: three kinds of recordings in, poses and twists out, faults in a line."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import CAMERA, READOUT_TIME, SHUTTER, flight, write_ros1

from rs_localizer.cli.main import main
from rs_localizer.io.bags import STORAGES, BagWriter, open_bag
from rs_localizer.io.outputs import TYPES
from rs_localizer.io.trajectories import read_tum, read_twists
from rs_localizer.simulation.recording import write_simulated
from rs_localizer.simulation.scene import room
from rs_localizer.simulation.settings import FrameSettings

FRAMES = 6
# Nanoseconds since 1970 that a float of seconds cannot hold.
START = 1_732_204_800_123_456_789


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A simulated flight with /truth beside the inputs."""
    path = tmp_path_factory.mktemp("bags") / "flight"
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    settings = FrameSettings(points=100, noise=0.5, outliers=0.2)
    with BagWriter(path) as bag:
        for frame in flight(world, FRAMES, settings, START):
            write_simulated(bag, CAMERA, frame)
    return path


def messages(path: Path) -> list[tuple[str, int, Any]]:
    with open_bag(path) as bag:
        return list(bag.messages(tuple(bag.topics)))


def rewrite(source: Path, target: Path, change: Any, storage: str = "mcap") -> Path:
    """A copy of a recording; ``change(topic, message)`` gives the topic, or None to leave out."""
    with BagWriter(target, storage) as bag:
        for topic, stamp_ns, message in messages(source):
            new_topic = change(topic, message)
            if new_topic is not None:
                bag.write(new_topic, message, stamp_ns)
    return target


def test_what_comes_out(recording, tmp_path, capsys):
    out = tmp_path / "deep" / "out"
    assert main(["replay", str(recording), "--out", str(out), *SHUTTER]) == 0
    captured = capsys.readouterr()
    words = {line.rsplit(None, 1)[0]: line.split()[-1] for line in captured.out.splitlines()}
    assert words["frames"] == words["localized"] == str(FRAMES)
    assert captured.err == ""  # no progress bar where nobody watches

    truth = {
        topic: [message for name, _, message in messages(recording) if name == topic]
        for topic in ("/truth/pose", "/truth/twist")
    }
    poses, twists = read_tum(out / "poses.txt"), read_twists(out / "twists.txt")
    assert len(poses) == len(twists) == FRAMES
    # The truth comes in pairs: at the stamp and at the middle row.
    for i, pose in enumerate(truth["/truth/pose"][::2]):
        stamp = pose.header.stamp.sec * 10**9 + pose.header.stamp.nanosec
        assert poses.stamps_ns[i] == twists.stamps_ns[i] == stamp
        position = pose.pose.position
        error = poses.positions[i] - (position.x, position.y, position.z)
        assert np.linalg.norm(error) < 0.05
    for i, twist in enumerate(truth["/truth/twist"][::2]):
        angular = twist.twist.angular
        error = twists.angular[i] - (angular.x, angular.y, angular.z)
        assert np.linalg.norm(error) < 0.3
    with open_bag(out / "result") as bag:
        assert bag.topics == {f"/rs_localizer/{name}": kind for name, kind in TYPES.items()}
        for topic in bag.topics:
            assert bag.count([topic]) == FRAMES
        recorded = [stamp for _, stamp, _ in bag.messages(["/rs_localizer/pose"])]
    assert recorded == [s for t, s, _ in messages(recording) if t == "/correspondences"]
    text = (out / "poses.txt").read_text()
    assert text.startswith(
        "# pose of 'camera_optical_frame' in 'map', map_from_body; t: s, the stamp of the image "
        "(pose_time: stamp)\n# x y z: m, its origin;"
    )
    assert "\n# t x y z qx qy qz qw\n1732204800." in text
    assert (out / "twists.txt").read_text().startswith("# velocity of 'camera_optical_frame' with")


def test_every_kind_of_recording_gives_the_same(recording, tmp_path):
    inputs = [message for message in messages(recording) if not message[0].startswith("/truth")]
    bags = [
        recording,
        next(recording.glob("*.mcap")),
        rewrite(recording, tmp_path / "sqlite", lambda topic, message: topic, "sqlite3"),
        write_ros1(tmp_path / "old.bag", inputs),
    ]
    texts = []
    for i, bag in enumerate(bags):
        out = tmp_path / f"out{i}"
        storage = list(STORAGES)[i % 2]
        arguments = ["--out", str(out), "--storage", storage, *SHUTTER]
        assert main(["replay", str(bag), *arguments]) == 0
        texts.append([(out / name).read_text() for name in ("poses.txt", "twists.txt")])
    assert texts.count(texts[0]) == len(bags)


def test_settings_of_a_file_and_of_the_command_line(recording, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text(
        f"/**:\n  ros__parameters: {{readout_time: {READOUT_TIME}, pose_time: mid_frame}}\n"
    )
    out = tmp_path / "out"
    arguments = ["replay", str(recording), "--params", str(file), "--out", str(out)]
    assert main(arguments) == 0
    middle = read_tum(out / "poses.txt").stamps_ns
    assert main([*arguments, "--overwrite", "-p", "pose_time:=stamp"]) == 0
    first = read_tum(out / "poses.txt").stamps_ns
    assert (middle - first).tolist() == [15_000_000] * FRAMES


def test_no_frame_localized_is_a_failure(recording, tmp_path, capsys):
    def empty(topic: str, message: Any) -> str:
        if topic == "/correspondences":
            message.width, message.row_step, message.data = 0, 0, np.zeros(0, np.uint8)
        return topic

    bag = rewrite(recording, tmp_path / "empty", empty)
    assert main(["replay", str(bag), "--out", str(tmp_path / "out")]) == 1
    captured = capsys.readouterr()
    assert f"no frame of {bag} was localized" in captured.err
    assert "refused: empty_cloud" in captured.out
