# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a replay makes of stamps, readings and topics; smoothing; sources of images."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from recorded import CAMERA, READOUT_TIME, flight, record

from rs_localizer.cli.commands import main
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.imu import make_reading
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.io.recording import make_camera_info
from rs_localizer.offline.image_sources import image_files, name_times
from rs_localizer.offline.recordings import read_imu_recording
from rs_localizer.offline.replay import (
    Item,
    find_topics,
    find_transforms,
    imu_first,
    imu_topics,
    prepare_replay,
    replay,
)
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings
from rs_localizer.tools.smoothing import smooth_frames

from ..pipeline.clouds import cloud_of  # noqa: TID252 - Python has a package "test"

YEARS = 17 * 10**17
CONFIG = NodeConfig(readout_time=READOUT_TIME)


@pytest.fixture(scope="module")
def frames():
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=3000)
    return flight(world, 9, FrameSettings(80, 0.5, 0.0), 0)


def answers(path, frames, start_ns, unset=()):
    """What replay answers to frames that begin at ``start_ns``, some of them without a stamp."""
    with BagWriter(path) as bag:
        for k, frame in enumerate(frames):
            then = start_ns + frame.stamp_ns
            cloud = cloud_of(0 if k in unset else then, frame.points, frame.pixels)
            bag.write("/camera_info", make_camera_info(CAMERA, then), then)
            bag.write("/correspondences", cloud, then)
    with open_bag(path) as bag:
        return [a.result for a in replay(bag, *prepare_replay(bag, CONFIG))]


def test_a_recording_that_starts_at_zero_has_its_first_frame(tmp_path, frames):
    found = answers(tmp_path / "bag", frames, 0)
    assert all(found)
    assert [frame.stamp_ns for frame in found] == [frame.stamp_ns for frame in frames]
    assert found[0].stamp_ns == 0


def test_frames_without_a_stamp_end_no_track(tmp_path, frames):
    found = answers(tmp_path / "bag", frames, YEARS, unset=(0, 3, 4))
    assert [k for k, result in enumerate(found) if not result] == [0, 3, 4]
    assert {found[k].reason for k in (0, 3, 4)} == {"no_stamp"}
    assert [result.estimate.tracked for result in found if result][1:] == [True] * (len(found) - 4)


MS = 1_000_000


def played(items: list[Item], needs: Callable[[str], int], imu: str | None = "imu") -> list[str]:
    """Messages as they come out; a frame needs a reading so many ms after its own time."""
    newest, out = -1, []

    def awaits(item: Item) -> bool:
        return item[0] == "frame" and newest < item[1] + needs(item[2]) * MS

    for topic, recorded_ns, message in imu_first(items, imu, awaits):
        if topic == "imu":
            newest = recorded_ns
        else:
            out.append(message)
        out += [message] if topic == "imu" else []
    return out


def recording() -> list[Item]:
    readings = [("imu", 10 * i * MS, f"r{i}") for i in range(12)]
    frames = [("frame", (25 + 30 * i) * MS, f"f{i}") for i in range(3)]
    infos = [("info", (24 + 30 * i) * MS, f"i{i}") for i in range(3)]
    return sorted([*readings, *frames, *infos], key=lambda item: item[1])


def test_a_frame_comes_when_its_readings_have():
    out = played(recording(), lambda name: 10)
    assert [name for name in out if name[0] != "r"] == ["i0", "f0", "i1", "f1", "i2", "f2"]
    assert out.index("f0") == out.index("r4") + 1  # 35 ms lie between r3 and r4
    assert out.index("i1") > out.index("f0")
    assert [name for name in out if name[0] == "r"] == [f"r{i}" for i in range(12)]


def test_a_frame_whose_readings_never_come_goes_on():
    items = recording()
    assert played(items, lambda name: 10_000)[-5:] == ["f0", "i1", "f1", "i2", "f2"]  # at its end
    late = [*items, ("info", 1100 * MS, "last"), ("imu", 1200 * MS, "r")]
    out = played(late, lambda name: 10_000)
    assert out.index("f2") < out.index("last")
    assert out[-1] == "r"


def test_without_an_imu_nothing_waits():
    items = [item for item in recording() if item[0] != "imu"]
    assert played(items, lambda name: 10_000, imu=None) == [item[2] for item in items]


GYRO, ACCEL = "/camera/gyro/sample", "/camera/accel/sample"
RATE, FORCE, NOTHING = np.array([0.1, 0.2, -0.3]), np.array([0.0, -9.8, 0.5]), np.zeros(3)


def recorded(path: Path, absent: bool, *more: str) -> Path:
    """A RealSense's topics: what one does not measure is zero, or its covariance says so."""
    with BagWriter(path) as bag:
        for k in range(200):
            stamp = 10**9 + 5_000_000 * k
            turning = k > 20  # it begins at rest
            for topic in (GYRO, *more):
                gyro = make_reading(stamp, RATE * turning, NOTHING, "imu")
                bag.write(topic, gyro, stamp)
            accel = make_reading(stamp, NOTHING, FORCE, "imu")
            if absent:
                accel.angular_velocity_covariance[0] = -1.0
            bag.write(ACCEL, accel, stamp)
    return path


@pytest.mark.parametrize("absent", [True, False])
def test_an_accelerometer_beside_it_is_no_choice(absent, tmp_path):
    with open_bag(recorded(tmp_path / "bag", absent)) as bag:
        assert imu_topics(bag) == [GYRO]
        readings = read_imu_recording(bag, None)  # of calibrate --imu
        np.testing.assert_array_equal(readings.angular_velocities[-1], RATE)


def test_two_gyroscopes_are_a_choice(tmp_path):
    with open_bag(recorded(tmp_path / "bag", False, "/other")) as bag:
        assert imu_topics(bag) == [GYRO, "/other"]


SETTINGS = NodeConfig(readout_time=0.03)
Recorded = tuple[CameraFrames, list[Localized], list[int]]
"""With what it was localized, the frames, the stamps of all images."""


@pytest.fixture(scope="module")
def smoothed(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    path = tmp_path_factory.mktemp("smoothed") / "flight"
    words = "--trajectory tum_vi_room5 --start 20 --duration 1 --points 40 --outliers 0"
    assert main(["simulate", str(path), *words.split(), "--seed", "3"]) == 0
    localizer = CameraFrames(SETTINGS)
    with open_bag(path) as bag:
        topics = find_topics(bag)
        frames = [frame for a in replay(bag, topics, localizer) if (frame := a.result)]
        stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
    assert len(frames) > 25
    return localizer, frames, stamps


def test_the_last_frame_is_smoothed_though_its_stamp_is_beyond_all(smoothed: Recorded) -> None:
    """As in a rig whose first camera has lost its last image."""
    localizer, frames, stamps = smoothed
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
        localizer = CameraFrames(SETTINGS, transforms=find_transforms(bag, topics, SETTINGS))
        frames = [frame for a in replay(bag, topics, localizer) if (frame := a.result)]
        stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
    part = smooth_frames(localizer, frames, stamps, None)
    assert part.shaken == len(part.frames) == len(frames) == 90
    assert all(one is other for one, other in zip(part.frames, frames, strict=True))


EVERY_33_MS = [0, 33_366_000, 66_733_000]


@pytest.mark.parametrize(
    ("first_ns", "unit"),
    [
        (1_403_636_579_763_000_000, 1),  # EuRoC's
        (1_403_636_579_763_000_000, 10**3),  # us since 1970: 16 digits
        (1_403_636_579_763_000_000, 10**6),
        (1_403_636_579_763_000, 1),  # ns since a phone was started: 16 digits, too
        (86_412_345_678_901, 1),
    ],
)
def test_their_unit_is_that_of_the_interval(first_ns, unit):
    files = [Path(f"{(first_ns + later) // unit}.png") for later in EVERY_33_MS]
    found = name_times(files)
    assert found is not None
    assert list(found) == files
    for file, later in zip(files, EVERY_33_MS, strict=True):
        assert abs(found[file] - first_ns - later) < unit


@pytest.mark.parametrize("names", [("0001", "0002", "0003"), ("10", "15", "20"), ("a", "b")])
def test_numbers_of_frames_are_none(names):
    assert name_times([Path(f"{name}.png") for name in names]) is None


def test_what_has_no_images_is_named(tmp_path, capsys):
    path = tmp_path / "bag"
    with BagWriter(path) as bag:
        bag.write("/eye/theora", make_message("std_msgs/msg/String", data=""), 10**9)
    assert main(["detect", str(path), "--board", "9x6", "--square", "0.03", "--out", "x"]) == 1
    assert "it has /eye/theora (std_msgs/msg/String)" in capsys.readouterr().err
    (tmp_path / "IMG_0001.heic").touch()
    with pytest.raises(ValueError, match=r"no file ends in \.jpg, .*convert others to PNG"):
        image_files(tmp_path)
