# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer replay --ros``: the recording's messages in the graph, paced, with /clock."""

import contextlib
import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import CameraInfo, CompressedImage, PointCloud2

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import make_camera_info, make_image, write_frame
from rs_localizer.ros.graph import player

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
            now = START_NS + i * PERIOD_NS
            write_frame(bag, Camera(640, 480, K), now, points, pixels, np.arange(20))
    return tmp_path / "bag"


def played(peer: Any, recording: Path, kinds: dict[str, type], *words: str) -> tuple[str, dict]:
    """What is printed, and what has come on these topics, and when (s)."""
    heard: dict[str, list[tuple[float, Any]]] = {topic: [] for topic in kinds}
    for topic, kind in kinds.items():
        peer.node.create_subscription(
            kind, topic, lambda m, to=heard[topic]: to.append((time.monotonic(), m)), 100
        )
    command = [sys.executable, "-m", "rs_localizer", "replay", str(recording), "--ros", *words]
    playing = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    assert peer.spin_until(lambda: playing.poll() is not None)
    output, errors = playing.communicate()
    assert (playing.returncode, errors) == (0, "")
    assert peer.spin_until(lambda: all(len(found) >= FRAMES for found in heard.values()))
    return output, heard


def test_everything_arrives_in_scaled_time_and_poses_are_counted(recording, peer):
    pose = "/cam/rs_localizer/pose"
    poses = peer.node.create_publisher(PoseStamped, pose, 10)
    peer.node.create_subscription(
        PointCloud2, "/correspondences", lambda _: poses.publish(PoseStamped()), 10
    )
    kinds = {"/correspondences": PointCloud2, "/camera_info": CameraInfo, "/clock": Clock}
    output, heard = played(peer, recording, kinds, "--rate", "0.5")
    told = re.fullmatch(
        rf"{FRAMES} frames published in (\S+) s\n(\d+) poses received on {pose}\n", output
    )
    assert told is not None
    assert 1 <= int(told[2]) <= FRAMES  # who answers is discovered while the first are played
    # Never sooner than at this rate; a busy machine takes its time.
    assert float(told[1]) >= 1.4
    clouds, infos = ([m for _, m in heard[t]] for t in ("/correspondences", "/camera_info"))
    with open_bag(recording) as bag:
        recorded = [message for _, _, message in bag.messages(["/correspondences"])]
    assert [stamp_ns(cloud) for cloud in clouds] == [stamp_ns(message) for message in recorded]
    assert all(bytes(c.data) == m.data.tobytes() for c, m in zip(clouds, recorded, strict=True))
    assert (len(infos), infos[0].k.tolist()) == (FRAMES, K.ravel().tolist())
    times, clocks = zip(*heard["/clock"], strict=True)
    stamps = np.array([c.clock.sec * 10**9 + c.clock.nanosec for c in clocks])
    assert np.all(np.diff(stamps) >= 0)
    assert stamps[-1] == START_NS + (FRAMES - 1) * PERIOD_NS
    assert len(stamps) > 5 * FRAMES
    assert (stamps[-1] - stamps[0]) * 1e-9 / (times[-1] - times[0]) < 0.6


def test_nobody_listens(monkeypatch):
    monkeypatch.setattr(player, "_DISCOVERY_TIMEOUT", 0.1)
    monkeypatch.setattr(player, "StopSignals", contextlib.nullcontext)
    types = {"/correspondences": "sensor_msgs/msg/PointCloud2"}
    with pytest.raises(player.PlayerError, match="nobody subscribes to /correspondences: start "):
        player.play([], types)


def test_images_are_played_for_a_detector(tmp_path, peer):
    """A recording of a camera alone: there is nothing for the localizer yet."""
    with BagWriter(tmp_path / "bag") as bag:
        for k in range(FRAMES):
            now = START_NS + k * PERIOD_NS
            bag.write("/cam/camera_info", make_camera_info(Camera(640, 480, K), now), now)
            image = make_image(now, "png", bytes([k]) * 100)
            bag.write("/cam/image/compressed", image, now)
    kinds = {"/cam/image/compressed": CompressedImage, "/cam/camera_info": CameraInfo}
    output, heard = played(peer, tmp_path / "bag", kinds, "--rate", "2")
    assert output.startswith(f"{FRAMES} images published in ")
    assert output.endswith("\nno node rs_localizer was there to publish poses\n")
    images = [bytes(image.data) for _, image in heard["/cam/image/compressed"]]
    assert images == [bytes([k]) * 100 for k in range(FRAMES)]
