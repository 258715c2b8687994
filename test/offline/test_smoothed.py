# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Smoothing of a recording's frames: which moments have one, and whose pose it is."""

from pathlib import Path

import pytest
from recorded import record

from rs_localizer.cli.commands import main
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.replay import find_topics, find_transforms, replay
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.tools.smoothing import smooth_frames

CONFIG = NodeConfig(readout_time=0.03)
Recorded = tuple[CameraFrames, list[Localized], list[int]]
"""With what it was localized, the frames, the stamps of all images."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    """One second, localized."""
    path = tmp_path_factory.mktemp("smoothed") / "flight"
    words = "--trajectory tum_vi_room5 --start 20 --duration 1 --points 40 --outliers 0"
    assert main(["simulate", str(path), *words.split(), "--seed", "3"]) == 0
    localizer = CameraFrames(CONFIG)
    with open_bag(path) as bag:
        topics = find_topics(bag)
        frames = [frame for a in replay(bag, topics, localizer) if (frame := a.result)]
        stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
    assert len(frames) > 25
    return localizer, frames, stamps


def test_the_last_frame_is_smoothed_though_its_stamp_is_beyond_all(recorded: Recorded) -> None:
    """As in a rig whose first camera has lost its last image."""
    localizer, frames, stamps = recorded
    found = smooth_frames(localizer, frames, stamps[:-1], None).frames
    assert found[-1].input_stamp_ns == frames[-1].input_stamp_ns == stamps[-1]


def test_frames_of_a_vibrating_camera_keep_their_own_poses(tmp_path: Path) -> None:
    """0.3 deg at 60 Hz: knots follow none of it, and would ruin all poses, sure of them."""
    path = tmp_path / "shaken"
    words = "--trajectory tum_vi_room5 --start 20 --duration 3 --points 80 --outliers 0"
    shaking = "--vibration 0.3 60 --imu --seed 4".split()
    record(path, *words.split(), *shaking)
    with open_bag(path) as bag:
        topics = find_topics(bag)
        localizer = CameraFrames(CONFIG, transforms=find_transforms(bag, topics, CONFIG))
        frames = [frame for a in replay(bag, topics, localizer) if (frame := a.result)]
        stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
    part = smooth_frames(localizer, frames, stamps, None)
    assert part.shaken == len(part.frames) == len(frames) == 90
    assert all(one is other for one, other in zip(part.frames, frames, strict=True))
