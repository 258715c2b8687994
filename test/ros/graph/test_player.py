# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay --ros``: the recording's messages in the graph, paced, with /clock."""

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2

from rs_localizer.cli.main import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.recording import make_camera_info, make_image, write_frame

FRAMES = 8
PERIOD_NS = 100_000_000
START_NS = 1_700_000_000_000_000_000
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


@pytest.fixture
def recording(tmp_path) -> Path:
    rng = np.random.default_rng(0)
    with BagWriter(tmp_path / "bag") as bag:
        for i in range(FRAMES):
            points, pixels = rng.normal(size=(20, 3)), rng.uniform(0, 400, size=(20, 2))
            stamp_ns = START_NS + i * PERIOD_NS
            write_frame(bag, Camera(640, 480, K), stamp_ns, points, pixels, np.arange(20))
    return tmp_path / "bag"


def play(recording: Path, *arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "rs_localizer", "replay", str(recording), "--ros", *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def test_everything_arrives_in_scaled_time(recording, peer):
    clouds: list[PointCloud2] = []
    infos: list[CameraInfo] = []
    clocks: list[tuple[float, int]] = []
    subscribe = peer.node.create_subscription
    subscribe(PointCloud2, "/correspondences", clouds.append, 10)
    subscribe(CameraInfo, "/camera_info", infos.append, 10)
    subscribe(
        Clock,
        "/clock",
        lambda message: clocks.append((time.monotonic(), nanoseconds(message.clock))),
        100,
    )
    player = play(recording, "--rate", "0.5")
    assert peer.spin_until(lambda: player.poll() is not None)
    output, errors = player.communicate()
    told = re.fullmatch(
        rf"{FRAMES} frames published in (\S+) s\nno node rs_localizer was there .*\n", output
    )
    assert told is not None
    # Never sooner than at this rate; a busy machine takes its time.
    assert float(told[1]) >= 1.4
    assert (player.returncode, errors) == (0, "")
    assert peer.spin_until(lambda: len(clouds) == len(infos) == FRAMES)

    with open_bag(recording) as bag:
        recorded = [message for _, _, message in bag.messages(["/correspondences"])]
    assert [nanoseconds(c.header.stamp) for c in clouds] == [
        nanoseconds(message.header.stamp) for message in recorded
    ]
    assert all(bytes(c.data) == m.data.tobytes() for c, m in zip(clouds, recorded, strict=True))
    assert infos[0].k.tolist() == K.ravel().tolist()
    times, stamps = np.array([t for t, _ in clocks]), np.array([s for _, s in clocks])
    assert np.all(np.diff(stamps) >= 0)
    assert stamps[-1] == START_NS + (FRAMES - 1) * PERIOD_NS
    assert len(stamps) > 5 * FRAMES
    assert (stamps[-1] - stamps[0]) * 1e-9 / (times[-1] - times[0]) < 0.6


def test_poses_of_a_node_are_counted(tmp_path, start_node):
    assert main(["simulate", str(tmp_path / "flight"), "--duration", "1", "--rate", "10"]) == 0
    output, errors = play(tmp_path / "flight").communicate(timeout=60)
    assert output == ""
    assert errors.startswith(
        "rs_localizer replay: nobody subscribes to /camera_info and /correspondences: start the "
    )
    assert errors.count("\n") == 1
    remapped = [f"{topic}:=/{topic}" for topic in ("camera_info", "correspondences")]
    names = ["-r", "__ns:=/cam", "-r", remapped[0], "-r", remapped[1]]
    node = start_node("-p", "readout_time:=0.03", *names)
    node.wait_for_log("active with solver")
    output, errors = play(tmp_path / "flight", "--rate", "0.5").communicate(timeout=60)
    assert errors == ""
    lines = output.splitlines()
    published = re.fullmatch(r"10 frames published in (\S+) s", lines[0])
    assert published is not None
    assert float(published[1]) >= 1.8
    counts = {line.split()[-1]: int(line.split()[0]) for line in lines[1:]}
    # The very first may be missed, and on a busy machine a newer one takes a frame's place.
    assert 1 <= counts["/cam/rs_localizer/pose"] <= 10
    assert counts.get("/rs_localizer/pose", 0) == 0


def test_images_are_played_for_a_detector(tmp_path, peer):
    """A recording of a camera alone: there is nothing for the localizer yet."""
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(FRAMES):
            stamp_ns = START_NS + k * PERIOD_NS
            bag.write("/cam/camera_info", make_camera_info(Camera(640, 480, K), stamp_ns), stamp_ns)
            image = make_image(stamp_ns, "png", bytes([k]) * 100)
            bag.write("/cam/image/compressed", image, stamp_ns)
    images: list[CompressedImage] = []
    infos: list[CameraInfo] = []
    subscribe = peer.node.create_subscription
    subscribe(CompressedImage, "/cam/image/compressed", images.append, 10)
    subscribe(CameraInfo, "/cam/camera_info", infos.append, 10)
    player = play(tmp_path / "bag", "--rate", "2")
    assert peer.spin_until(lambda: player.poll() is not None)
    output, errors = player.communicate()
    assert (player.returncode, errors) == (0, "")
    assert output.startswith(f"{FRAMES} images published in ")
    assert peer.spin_until(lambda: len(images) == len(infos) == FRAMES)
    assert [bytes(image.data) for image in images] == [bytes([k]) * 100 for k in range(FRAMES)]
