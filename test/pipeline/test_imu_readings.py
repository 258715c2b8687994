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
from rs_localizer.offline.results import Tally, summary
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

Change = Callable[[Any, float], Iterable[Any]]
"""A message of the IMU and when it comes (s since the first frame): what comes instead."""


class Flight:
    def __init__(self, path: Path) -> None:
        truth = read_motions(path, "/truth/pose", "/truth/twist").poses
        places = zip(truth.positions, truth.quaternions, strict=True)
        self.truth = dict(zip(truth.stamps_ns.tolist(), places, strict=True))
        with open_bag(path) as bag:
            self.items = list(bag.messages(["/imu", "/camera_info", "/correspondences"]))
            (self.mounting,) = [m for _, _, m in bag.messages(["/tf_static"])]
        stamps = [ns for topic, ns, _ in self.items if topic == "/correspondences"]
        self.start_ns, self.count = stamps[0], len(stamps)

    def changed(self, change: Change) -> Iterable[tuple[str, int, Any]]:
        for topic, ns, message in self.items:
            seconds = (ns - self.start_ns) * 1e-9
            for item in change(message, seconds) if topic == "/imu" else (message,):
                yield topic, ns, item


@pytest.fixture(scope="module")
def flight(tmp_path_factory) -> Flight:
    path = tmp_path_factory.mktemp("bags") / "flight"
    record(path, *FLIGHT)
    return Flight(path)


class Flown:
    """What became of the frames of a flight, or of so many of them."""

    def __init__(
        self, flight: Flight, change: Change = lambda message, time: (message,),
        config: NodeConfig = CONFIG, mounting: Any = None, most: int = 1000,
    ) -> None:  # fmt: skip
        self.flight, self.results = flight, list[Localized | Refusal]()
        self.notices: Counter[str] = Counter()
        self.said: list[str] = []
        tree = TransformTree()
        if mounting is not False:
            tree.add(mounting or flight.mounting, static=True)

        def notice(name: str, text: str) -> None:
            self.notices[name] += 1
            self.said.append(text)

        localizer = CameraFrames(config, notice, tree)

        def awaits(item: tuple[str, int, Any]) -> bool:
            frame = item[0] == "/correspondences"
            return frame and localizer.awaits_readings(stamp_ns(item[2]), 1.0)

        for topic, _, message in imu_first(flight.changed(change), "/imu", awaits):
            if len(self.results) == most:
                break
            if topic == "/camera_info":
                localizer.calibrate(read_camera_info(message))
            elif topic == "/imu":
                localizer.aid.add(read_imu(message))
            else:
                self.results.append(localizer.localize(message))
        self.aid = localizer.aid

    def errors(self) -> Any:
        """Degrees and metres (n,2) of each frame, and their largest deviations (n,2)."""
        found = []
        for frame in self.results:
            place, turn = self.flight.truth[frame.stamp_ns]
            off = Rotation.from_quat(turn).inv() * Rotation.from_matrix(frame.pose.rotation)
            far = np.linalg.norm(frame.pose.position - place)
            widest = np.sqrt(np.diag(frame.pose.covariance).reshape(2, 3).max(axis=1))
            found.append([math.degrees(off.magnitude()), far, math.degrees(widest[1]), widest[0]])
        return np.hsplit(np.array(found), 2)

    def assert_none_is_lost_or_wrong(self) -> None:
        """Wrong is what is far off, and farther than its covariance says."""
        assert len(self.results) == self.flight.count
        assert all(self.results)
        off, deviations = self.errors()
        assert np.all(off < np.maximum([0.6, 0.03], 5.0 * deviations))
        assert np.all(np.median(off, axis=0) < [0.2, 0.005])


def later(message: Any, seconds: float) -> Any:
    result = copy.deepcopy(message)
    stamp = stamp_ns(message) + round(seconds * 1e9)
    result.header.stamp.sec, result.header.stamp.nanosec = divmod(stamp, 10**9)
    return result


def test_it_makes_poses_better(flight):
    both, alone = Flown(flight), Flown(flight, lambda message, time: ())
    both.assert_none_is_lost_or_wrong()
    assert both.aid.share > 0.95  # one frame in a thousand contradicts it by chance
    assert both.aid.values()["IMU rate (Hz)"] == "400.0"
    assert alone.aid.values() == {}  # whoever has no IMU hears nothing of it
    assert np.median(both.errors()[0][:, 0]) < 0.75 * np.median(alone.errors()[0][:, 0])
    # An IMU that is not used changes nothing, to the last bit.
    for other in Flown(flight, config=WITHOUT, most=30), Flown(flight, mounting=False, most=30):
        for a, b in zip(other.results, alone.results[:30], strict=True):
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
    flown = Flown(flight, change)
    flown.assert_none_is_lost_or_wrong()
    assert flown.aid.reasons[reason] > 0
    lasts = fault not in ("is cut", "begins late")
    assert flown.notices[reason] == lasts  # told once, not at every frame
    told = summary(Tally(0, {}, aid=flown.aid), NodeConfig(), Path("out"), timed=False)
    assert any(line.startswith(f"{reason}: ") for line in told)


def test_a_wrong_mounting_is_noticed(flight):
    upside_down = copy.deepcopy(flight.mounting)
    rotation = upside_down.transforms[0].transform.rotation
    wrong = Rotation.from_quat([rotation.x, rotation.y, rotation.z, rotation.w])
    wrong = wrong * Rotation.from_euler("x", 180.0, degrees=True)
    rotation.x, rotation.y, rotation.z, rotation.w = wrong.as_quat().tolist()
    flown = Flown(flight, mounting=upside_down)
    flown.assert_none_is_lost_or_wrong()
    assert flown.aid.mostly.reason == ImuReason.DISAGREES
    words = "the camera's x y z are its -x -y z"
    assert f"the gyroscope is not used: {words}" in flown.said
    assert flown.aid.values()["IMU contradicted by the camera"] == words


@pytest.mark.parametrize(("down", "degrees"), [((0.0, 0.0, -1.0), 0.0), ((0.0, 1.0, 0.0), 90.0)])
def test_gravity_is_compared_with_the_map(flight, down, degrees):
    imu = Imu(gravity=True)
    config = NodeConfig(readout_time=READOUT_TIME, imu=imu, gravity_in_map=down)
    flown = Flown(flight, config=config)
    assert math.degrees(flown.aid.gravity) == pytest.approx(degrees, abs=5.0)


def test_without_a_readout_time_or_for_a_global_shutter_it_is_not_used_and_that_is_told(flight):
    for config, reason in (
        (NodeConfig(), ImuReason.NO_READOUT_TIME),
        (NodeConfig(readout_time=READOUT_TIME, solver="p3p"), ImuReason.NOT_TRACKING),
    ):
        flown = Flown(flight, config=config, most=8)
        assert flown.aid.mostly.reason == reason
        assert flown.notices[reason] == 1


def test_an_imu_in_the_frame_of_the_camera_needs_no_transform():
    samples = ImuSamples(np.arange(9), np.ones((9, 3)), None)
    found = in_camera_axes(samples, TransformTree(), ("a", "a"), 0)
    assert found.angular_velocity is samples.angular_velocity
    with pytest.raises(TransformError, match="does not exist"):
        in_camera_axes(samples, TransformTree(), ("camera", "imu"), 0)
