# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay`` of matches, images and keypoints: poses and twists, faults in a line."""

import dataclasses
import weakref
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import recorded
from numpy.lib.recfunctions import repack_fields
from recorded import CAMERA, READOUT_TIME, SHUTTER, flight, record, tf, write_mp4, write_ros1
from rosbags.rosbag2 import StoragePlugin
from scipy.spatial.transform import Rotation

from benchmarks.fuzzing import map_rows
from rs_localizer.cli.commands import main
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.camera_files import write_calibration
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.images import decode_image
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES, Localized
from rs_localizer.io.trajectories import read_motions, read_tum, read_twists
from rs_localizer.offline import results
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings
from rs_localizer.tools.simulation.simulated_recording import (
    keypoint_rows,
    random_descriptors,
    write_simulated,
)

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


READOUT = 0.02


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bag of images, and beside it the same as a video with its calibration."""
    path = tmp_path_factory.mktemp("images") / "walls"
    words = ["--images", "--duration", "0.4", "--readout-time", str(READOUT)]
    assert main(["simulate", str(path), *words, "--trajectory", "tum_vi_room5"]) == 0
    with open_bag(path) as bag:
        (topic,) = (t for t, kind in bag.topics.items() if kind.endswith("Image"))
        images = [decode_image(bytes(m.data), m.format) for _, _, m in bag.messages([topic])]
        (info,) = (t for t, kind in bag.topics.items() if kind.endswith("CameraInfo"))
        camera = read_camera_info(next(m for _, _, m in bag.messages([info]))).camera(
            0.0, "top_to_bottom"
        )
    write_mp4(path.parent / "walls.mp4", images, 30.0)
    write_calibration(path.parent / "camera.yaml", camera)
    return path


@pytest.mark.parametrize("kind", ["bag", "video"])
def test_poses_are_those_of_detect_and_replay(kind: str, walls: Path, tmp_path: Path) -> None:
    folder = walls.parent
    source = [str(walls)]
    if kind == "video":
        source = [str(folder / "walls.mp4"), "--calibration", str(folder / "camera.yaml")]
    given = [*source, "--map", str(walls / "marker_map.yaml"), "-p", f"readout_time:={READOUT}"]
    more = ["-p", "inlier_threshold:=2.5", "--smooth"]
    seen, steps, once = tmp_path / "seen", tmp_path / "steps", tmp_path / "once"
    assert main(["detect", *given, "--images", "--out", str(seen)]) == 0
    shutter = ["--params", str(seen / "parameters.yaml"), *more]
    assert main(["replay", str(seen), *shutter, "--out", str(steps)]) == 0
    assert main(["replay", *given, *more, "--out", str(once)]) == 0
    for name in ("poses.txt", "twists.txt"):
        rows = [np.loadtxt(place / name) for place in (steps, once)]
        assert len(rows[0]) > 5
        np.testing.assert_array_equal(*rows)


def test_what_is_missing_is_said(walls: Path, tmp_path: Path, capsys: Any) -> None:
    words = ["replay", str(walls.parent / "walls.mp4"), "--out", str(tmp_path / "out"), "--map"]
    assert main([*words, str(walls / "marker_map.yaml")]) == 2
    assert "a video or folder has no camera_info: give --camera" in capsys.readouterr().err
    (empty := tmp_path / "empty").mkdir()
    assert main(["detect", str(empty), *words[2:], str(walls / "marker_map.yaml")]) == 1
    assert "empty has no images" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
    assert main(["replay", str(walls.parent / "walls.mp4")]) == 1
    assert "walls.mp4 is a video, not matches: give --map, of markers" in capsys.readouterr().err


COUNT = 8
POINTS = room(np.zeros((1, 3)), np.random.default_rng(0), count=6000)
LANDMARKS = Map(
    POINTS, np.arange(6000) + 7, random_descriptors(6000, np.random.default_rng(1)), "map"
)


def test_a_recording_of_everything(tmp_path, capsys, ran):
    """By the id or by the points themselves: the frames since the map came are the same."""
    seen = FrameSettings(points=80, noise=0.5, outliers=0.2)
    with BagWriter(tmp_path / "all") as bag:
        for frame in recorded.flight(POINTS, COUNT, seen, 10**9):
            write_simulated(bag, recorded.CAMERA, frame)
            rows = keypoint_rows(frame, LANDMARKS, np.random.default_rng(frame.stamp_ns))
            for topic, names in {
                "/cam/keypoints": ["u", "v", "descriptor"], "/ids": ["u", "v", "id"],
            }.items():  # fmt: skip
                message = make_cloud(
                    make_message, frame.stamp_ns, "camera", repack_fields(rows[names])
                )
                bag.write(topic, message, frame.stamp_ns)
            if frame.stamp_ns == 10**9 + 66_666_667:  # late: with the third frame
                message = make_cloud(make_message, 0, "map", map_rows(LANDMARKS))
                bag.write("/cam/map_points", message, frame.stamp_ns - 1)
    words = ["replay", str(tmp_path / "all"), *SHUTTER]
    assert "choose with -r correspondences:=TOPIC or -r keypoints:=TOPIC" in ran(*words, code=1).err
    found = {}
    for name, given in {
        "clouds": ["-r", "correspondences:=/correspondences"],
        "ids": ["-r", "keypoints:=/ids", "-r", "map_points:=/cam/map_points"],
        "descriptors": ["-r", "keypoints:=cam/keypoints"],
    }.items():
        assert main([*words, *given, "--out", str(tmp_path / name)]) == 0
        found[name] = read_tum(tmp_path / name / "poses.txt").positions
    assert "map_replaced" not in capsys.readouterr().out
    assert len(found["clouds"]) == COUNT
    for name in ("ids", "descriptors"):
        np.testing.assert_allclose(found[name], found["clouds"][2:], atol=0.01)


def test_a_recording_beside_its_map(tmp_path, ran):
    flight, out = tmp_path / "flight", tmp_path / "poses"
    record(flight, "--keypoints", "--duration", "0.4", "--points", "200")
    words = ["--params", f"{flight}/parameters.yaml", "--map", f"{flight}/map.npz"]
    assert "and no map; give one with --map" in ran("replay", flight, *words[:2], code=1).err
    assert main(["replay", str(flight), *words, "--out", str(out)]) == 0
    found = read_tum(out / "poses.txt")
    truth = read_motions(flight, "/truth/pose", "/truth/twist").poses
    assert len(found) == 12
    off = found.positions - truth.positions[np.isin(truth.stamps_ns, found.stamps_ns)]
    assert np.median(np.linalg.norm(off, axis=1)) < 0.02
