# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""An IMU that stops, lies, is late or is lost now and then: no frame is lost, none is wrong."""

import copy
import math
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded import record
from scipy.spatial.transform import Rotation

from rs_localizer.config import Imu, NodeConfig
from rs_localizer.core.reasons import ImuReason
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import Localized
from rs_localizer.io.trajectories import read_motions
from rs_localizer.io.transforms import TransformError, TransformTree
from rs_localizer.offline.replay import imu_first
from rs_localizer.pipeline.aid import in_camera_axes
from rs_localizer.pipeline.camera_frames import CameraFrames, Refusal

READOUT_TIME = 0.03
CONFIG = NodeConfig(readout_time=READOUT_TIME)
WITHOUT = NodeConfig(readout_time=READOUT_TIME, imu=Imu(use="none"))
# A camera in a hand that shakes by a tenth of a degree: alone, it is localized, if badly.
FLIGHT = (
    "--trajectory", "tum_vi_room5", "--start", "20", "--duration", "3", "--points", "80",
    "--noise", "0.3", "--outliers", "0.1", "--imu", "--vibration", "0.1", "60",
)  # fmt: skip

Item = tuple[str, int, Any]
Change = Callable[[Any, float], Iterable[Any]]
"""A message of the IMU and when it comes (s since the first frame): what comes instead."""


class Flight:
    """A recording in memory."""

    def __init__(self, path: Path) -> None:
        self.truth = read_motions(path, "/truth/pose", "/truth/twist").poses
        with open_bag(path) as bag:
            self.items = list(bag.messages(["/imu", "/camera_info", "/correspondences"]))
            (self.mounting,) = [m for _, _, m in bag.messages(["/tf_static"])]
        self.start_ns = next(ns for topic, ns, _ in self.items if topic == "/correspondences")

    def since_start(self, recorded_ns: int) -> float:
        return (recorded_ns - self.start_ns) * 1e-9


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Flight:
    path = tmp_path_factory.mktemp("bags") / "flight"
    record(path, *FLIGHT)
    return Flight(path)


class Flown:
    """What became of the frames."""

    def __init__(self, flight: Flight) -> None:
        self._truth = flight.truth
        self.results: list[Localized | Refusal] = []
        self.notices: Counter[str] = Counter()
        self.state: Any = None

    @property
    def frames(self) -> list[Localized]:
        return [result for result in self.results if isinstance(result, Localized)]

    def errors(self) -> tuple[Any, Any]:
        """Degrees and metres of each frame."""
        rows = {stamp: row for row, stamp in enumerate(self._truth.stamps_ns.tolist())}
        degrees, metres = [], []
        for frame in self.frames:
            row = rows[frame.stamp_ns]
            true = Rotation.from_quat(self._truth.quaternions[row])
            turn = true.inv() * Rotation.from_matrix(frame.pose.rotation)
            degrees.append(math.degrees(turn.magnitude()))
            metres.append(np.linalg.norm(frame.pose.position - self._truth.positions[row]))
        return np.array(degrees), np.array(metres)

    def assert_none_is_lost_or_wrong(self, count: int) -> None:
        """Wrong is what is far off, and farther than its covariance says."""
        assert len(self.frames) == count
        degrees, metres = self.errors()
        covariances = np.array([frame.pose.covariance for frame in self.frames])
        variances = np.diagonal(covariances, axis1=1, axis2=2)
        place, turn = (np.sqrt(variances[:, part].max(axis=1)) for part in (slice(3), slice(3, 6)))
        assert np.all(metres < np.maximum(0.03, 5.0 * place))
        assert np.all(degrees < np.maximum(0.6, 5.0 * np.degrees(turn)))
        assert np.median(metres) < 0.005
        assert np.median(degrees) < 0.2


def fly(
    flight: Flight,
    change: Change = lambda message, time: (message,),
    config: NodeConfig = CONFIG,
    mounting: Any = None,
    most: int = 1000,
) -> Flown:
    """Localize a flight, or so many of its frames."""
    flown = Flown(flight)
    tree = TransformTree()
    if mounting is not False:
        tree.add(mounting or flight.mounting, static=True)
    frames = CameraFrames(config, lambda name, _: flown.notices.update((name,)), tree)

    def changed() -> Iterable[Item]:
        for topic, recorded_ns, message in flight.items:
            if topic != "/imu":
                yield topic, recorded_ns, message
                continue
            for item in change(message, flight.since_start(recorded_ns)):
                yield topic, recorded_ns, item

    def awaits(item: Item) -> bool:
        frame = item[0] == "/correspondences"
        return frame and frames.awaits_readings(stamp_ns(item[2]), 1.0)

    for topic, _, message in imu_first(changed(), "/imu", awaits):
        if len(flown.results) == most:
            break
        if topic == "/camera_info":
            frames.calibrate(read_camera_info(message))
        elif topic == "/imu":
            frames.aid.add(read_imu(message))
        else:
            flown.results.append(frames.localize(message))
    flown.state = frames.aid.state
    return flown


def count(flight: Flight) -> int:
    return sum(topic == "/correspondences" for topic, _, _ in flight.items)


def later(message: Any, seconds: float) -> Any:
    result = copy.deepcopy(message)
    stamp = stamp_ns(message) + round(seconds * 1e9)
    result.header.stamp.sec, result.header.stamp.nanosec = divmod(stamp, 10**9)
    return result


def test_it_makes_poses_better(flight):
    both, alone = fly(flight), fly(flight, lambda message, time: ())
    both.assert_none_is_lost_or_wrong(count(flight))
    assert both.state.share > 0.95  # one frame in a thousand contradicts it by chance
    assert both.state.rate == pytest.approx(400.0)
    assert alone.state is None  # whoever has no IMU hears nothing of it
    assert np.median(both.errors()[0]) < 0.75 * np.median(alone.errors()[0])
    # An IMU that is not used changes nothing, to the last bit.
    for other in (
        fly(flight, config=WITHOUT, most=30),
        fly(flight, mounting=False, most=30),
    ):
        for a, b in zip(other.frames, alone.frames[:30], strict=True):
            assert np.array_equal(a.pose.position, b.pose.position)
            assert np.array_equal(a.pose.rotation, b.pose.rotation)


def without(start: float, end: float) -> Change:
    return lambda message, time: () if start < time < end else (message,)


# What the buffer of samples by itself says of others is in test/inertial/test_samples.py.
FAULTS: dict[str, tuple[Change, ImuReason]] = {
    "stops": (without(1.0, 9.0), ImuReason.STOPPED),
    "begins late": (without(-9.0, 1.0), ImuReason.BEGINS_LATER),
    "is set back": (
        lambda message, time: (later(message, -5.0 if time > 1.0 else 0.0),), ImuReason.STOPPED
    ),
    "is cut": (without(1.0, 1.05), ImuReason.GAP),
}  # fmt: skip


@pytest.mark.parametrize("fault", FAULTS)
def test_the_camera_goes_on_alone(flight, fault):
    change, reason = FAULTS[fault]
    flown = fly(flight, change)
    flown.assert_none_is_lost_or_wrong(count(flight))
    assert flown.state.reasons[reason] > 0
    lasts = fault not in ("is cut", "begins late")
    assert flown.notices[reason] == lasts  # told once, not at every frame


def test_a_wrong_mounting_is_noticed(flight):
    upside_down = copy.deepcopy(flight.mounting)
    rotation = upside_down.transforms[0].transform.rotation
    wrong = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w])
    wrong = wrong * Rotation.from_euler("x", 180.0, degrees=True)
    rotation.x, rotation.y, rotation.z, rotation.w = wrong.as_quat().tolist()
    flown = fly(flight, mounting=upside_down)
    flown.assert_none_is_lost_or_wrong(count(flight))
    assert flown.state.mostly.reason == ImuReason.DISAGREES


@pytest.mark.parametrize(("down", "degrees"), [((0.0, 0.0, -1.0), 0.0), ((0.0, 1.0, 0.0), 90.0)])
def test_gravity_is_compared_with_the_map(flight, down, degrees):
    imu = Imu(gravity=True)
    config = NodeConfig(readout_time=READOUT_TIME, imu=imu, gravity_in_map=down)
    flown = fly(flight, config=config)
    assert math.degrees(flown.state.gravity) == pytest.approx(degrees, abs=5.0)


def test_without_a_readout_time_or_for_a_global_shutter_it_is_not_used_and_that_is_told(flight):
    for config, reason in (
        (NodeConfig(), ImuReason.NO_READOUT_TIME),
        (NodeConfig(readout_time=READOUT_TIME, solver="p3p"), ImuReason.NOT_TRACKING),
    ):
        flown = fly(flight, config=config, most=8)
        assert flown.state.mostly.reason == reason
        assert flown.notices[reason] == 1


def test_an_imu_in_the_frame_of_the_camera_needs_no_transform():
    samples = ImuSamples(np.arange(9), np.ones((9, 3)), None)
    found = in_camera_axes(samples, TransformTree(), ("a", "a"), 0)
    assert found.angular_velocity is samples.angular_velocity
    with pytest.raises(TransformError, match="does not exist"):
        in_camera_axes(samples, TransformTree(), ("camera", "imu"), 0)
