# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay``: three kinds of recordings in, poses and twists out, faults in a line."""

import dataclasses
import weakref
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import CAMERA, READOUT_TIME, SHUTTER, flight, tf, write_ros1
from rosbags.rosbag2 import StoragePlugin
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES, Localized
from rs_localizer.io.trajectories import read_motions, read_tum, read_twists
from rs_localizer.offline import results
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings
from rs_localizer.tools.simulation.simulated_recording import write_simulated

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


def test_results_that_wait_for_frames_come_at_the_end(recording, tmp_path):
    """As many as without, of the same frames in the same order, each once."""
    from pyarrow.parquet import read_table  # an extra

    words, lag, found = ["replay", str(recording), *SHUTTER, "--parquet"], 3, []
    for k in (0, lag):
        out, table = tmp_path / f"out{k}", tmp_path / f"{k}.parquet"
        given = [str(table), "--out", str(out), "-p", f"output_lag:={k}"]
        assert main([*words, *given]) == 0
        sent = Counter((name, stamp_ns(message)) for name, _, message in messages(out / "result"))
        rows = read_table(table)["stamp_ns"].to_pylist()
        found.append((read_tum(out / "poses.txt"), sent, rows))
    (at_once, *others), (later, *again) = found
    assert others == again
    assert len(others[1]) == len(later.stamps_ns) == FRAMES
    np.testing.assert_array_equal(later.stamps_ns, at_once.stamps_ns)
    # The later a result, the better it is known: it is another one.
    assert not np.array_equal(later.positions, at_once.positions)


def test_what_comes_out(recording, tmp_path, ran):
    out = tmp_path / "deep" / "out"
    captured = ran("replay", recording, "--out", out, *SHUTTER)
    assert captured.err == ""  # no progress bar where nobody watches
    rows = dict(line.rsplit(None, 1) for line in captured.out.splitlines())
    assert rows["frames"] == rows["localized"] == str(FRAMES)
    assert 0.2 < float(rows["residual of the inliers (px rms, median)"]) < 1.0
    assert 12 <= int(rows["  inliers"]) <= int(rows["points of a frame (median)"])
    # All but the first.
    assert rows["tracked from the frame before"] == f"{(FRAMES - 1) / FRAMES:.1%}"

    truth = read_motions(recording, "/truth/pose", "/truth/twist")
    poses, twists = read_tum(out / "poses.txt"), read_twists(out / "twists.txt")
    assert len(poses) == FRAMES
    np.testing.assert_array_equal(poses.stamps_ns, twists.stamps_ns)
    # The truth comes in pairs: at the stamp and at the middle row.
    np.testing.assert_array_equal(poses.stamps_ns, truth.poses.stamps_ns[::2])
    np.testing.assert_allclose(poses.positions, truth.poses.positions[::2], atol=0.05)
    np.testing.assert_allclose(twists.angular, truth.twists.angular[::2], atol=0.3)
    np.testing.assert_allclose(twists.linear, truth.twists.linear[::2], atol=0.4)
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
    """Of a camera that looks to the left from the front of a base; with the infos at the end."""
    inputs = [message for message in messages(recording) if not message[0].startswith("/truth")]
    place = (0.5, 0.2, 0.9), Rotation.from_euler("x", -90.0, degrees=True)
    mounting = ("/tf_static", START, tf("base_link", "camera_optical_frame", *place))
    for kind in StoragePlugin:
        with BagWriter(tmp_path / kind.name, kind) as bag:
            for topic, stamp_ns, message in (mounting, *sorted(inputs, key=lambda it: it[0][::-1])):
                bag.write(topic, message, stamp_ns if topic != "/camera_info" else 2 * START)
    # ROS 1 before tf2: another type, slashes before the names, and the mounting on /tf.
    old = [
        ("/tf", START + later, tf("/base_link", "/camera_optical_frame", *place, START + later))
        for later in (-(10**9), 10**9)
    ]
    one_file = next((tmp_path / "MCAP").glob("*.mcap"))
    bags = [*(tmp_path / kind.name for kind in StoragePlugin), one_file]
    bags.append(write_ros1(tmp_path / "old.bag", [*inputs, *old]))
    texts = []
    for i, bag in enumerate(bags):
        out = tmp_path / f"out{i}"
        arguments = ["--out", str(out), "-p", "base_frame:=base_link", *SHUTTER]
        assert main(["replay", str(bag), *arguments]) == 0
        texts.append([(out / name).read_text() for name in ("poses.txt", "twists.txt")])
    assert texts[:3] == 3 * texts[:1]
    for one, other in zip(texts[0], texts[3], strict=True):
        numbers = [np.loadtxt(text.splitlines()) for text in (one, other)]
        np.testing.assert_allclose(*numbers, rtol=0.0, atol=1e-6)


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


def test_no_frame_localized_is_a_failure(recording, tmp_path, ran):
    with BagWriter(tmp_path / "empty") as bag:
        for topic, stamp_ns, message in messages(recording):
            if topic == "/correspondences":
                message.width, message.row_step, message.data = 0, 0, np.zeros(0, np.uint8)
            bag.write(topic, message, stamp_ns)
    captured = ran("replay", tmp_path / "empty", "--out", tmp_path / "out", code=1)
    assert f"no frame of {tmp_path / 'empty'} was localized" in captured.err
    assert "refused: empty_cloud" in captured.out


def test_frames_are_written_as_they_come_and_let_go(recording, tmp_path, monkeypatch):
    """An hour of them would take gigabytes."""
    real = results.replay
    alive, most = weakref.WeakSet[Localized](), 0

    class Watched(Localized):
        """That a weak reference can be to."""

    def many(*arguments: Any) -> Any:
        nonlocal most
        answer = next(iter(real(*arguments)))
        first = answer.result
        values = {item.name: getattr(first, item.name) for item in dataclasses.fields(first)}
        for k in range(300):
            frame = Watched(**values | {"stamp_ns": first.stamp_ns + k})
            alive.add(frame)
            most = max(most, len(alive))
            yield answer._replace(result=frame)

    monkeypatch.setattr(results, "replay", many)
    assert main(["replay", str(recording), "--out", str(tmp_path / "out"), *SHUTTER]) == 0
    assert len(read_tum(tmp_path / "out" / "poses.txt")) == 300
    assert most < 10
