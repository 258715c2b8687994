# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The diagnosis of a node: what a user reads first when there are no poses."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rs_localizer.io.outputs import CameraShare
from rs_localizer.pipeline.map_to_odom import CorrectionState, Decision, Standing
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.localizer.health import Condition, diagnose, integrity_message, tell
from rs_localizer.ros.node.diagnostics import Level
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import Statistics
from rs_localizer.ros.node.subscriptions import Silence

COMES = Silence("/camera_info", 0.1, heard=True, cause="", mismatch=False)
FRAMES = replace(COMES, topic="/correspondences")
GOOD = Condition("active", (), {"camera_info": COMES, "correspondences": FRAMES})


def frame(stamp: float = 0.0, tracked: bool = False, rig: bool = False) -> Any:
    """Three inliers of four points, 3, 4 and 0 px off; of a rig, one is of another camera."""
    estimate = SimpleNamespace(
        inliers=np.array([True, True, False, True]),
        residuals=np.array([3.0, 4.0, 100.0, 0.0]),
        iterations=64,
        model_error=0.0,
        tracked=tracked,
        lens=None,
    )
    cameras = (CameraShare("front", 3, 2, 3.5), CameraShare("rear", 1, 1, 0.0))
    pose = SimpleNamespace(covariance=np.diag([1e-6, 4e-6, 4e-6, 1.0, 1.0, 1.0]))  # 3 mm
    return SimpleNamespace(
        input_stamp_ns=round(stamp * 1e9), estimate=estimate, pose=pose,
        cameras=cameras if rig else (), twist=None,
    )  # fmt: skip


class World:
    """Statistics with clocks that are set by hand."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.refusals = Refusals(lambda text: None)
        self.statistics = Statistics(
            self.refusals, tell, lambda: round(self.now * 1e9), lambda: self.now
        )

    def receive(self) -> None:
        seconds, nanoseconds = divmod(round(self.now * 1e9), 1_000_000_000)
        stamp = SimpleNamespace(sec=seconds, nanosec=nanoseconds)
        message = SimpleNamespace(header=SimpleNamespace(stamp=stamp))
        self.statistics.received("correspondences", message)

    def pass_frames(self, count: int, rate: float, latency: float = 0.0) -> None:
        for _ in range(count):
            self.receive()
            self.now += latency
            self.statistics.answered(frame(self.now - latency), self.now - latency)
            self.now += 1.0 / rate - latency

    def refuse(self, count: int) -> None:
        for _ in range(count):
            self.receive()
            self.statistics.refused(Refusal("too_few_inliers", "7 of 100"))
            self.now += 0.01

    def diagnose(self, condition: Condition = GOOD) -> Any:
        return diagnose(condition, self.statistics.summary())


@pytest.fixture
def world() -> World:
    return World()


def test_numbers_of_a_working_node(world):
    world.pass_frames(100, rate=50.0, latency=0.004)
    health = world.diagnose()
    assert (health.level, health.state) == (Level.OK, "localized")
    assert health.message == "localized with 3 of 4 points"
    values = health.values
    assert (values["Frames in (Hz)"], values["Poses out (Hz)"]) == ("50.0", "50.0")
    assert (values["Latency p50 (ms)"], values["Delay of the stamp p95 (ms)"]) == ("4.00", "4.00")
    assert float(values["Residual RMS (px)"]) == pytest.approx(np.sqrt(25.0 / 3.0), abs=1e-3)
    assert values["Position deviation (cm)"] == "0.30"
    assert (values["Frames received"], values["Frames answered"]) == ("100", "100")
    assert values["Topic /correspondences"] == "messages arrive, best effort"
    world.now += 6.0  # the window is over: nothing of it is said to be so now
    values = world.diagnose().values
    assert values["Poses out (Hz)"] == "0.0"
    assert "Latency p50 (ms)" not in values
    assert values["Frames answered"] == "100"


def test_lost_after_some_frames_and_found_by_one(world):
    world.pass_frames(10, rate=50.0)
    world.refuse(4)
    assert world.diagnose().level == Level.WARN
    assert world.diagnose().message == "4 frames were refused in the last 5 s"
    world.refuse(1)
    health = world.diagnose()
    assert (health.level, health.state) == (Level.ERROR, "lost")
    assert health.message == "the last 5 frames gave no pose, mostly for too_few_inliers"
    assert health.values["Refused: too_few_inliers"] == "5"
    world.pass_frames(1, rate=50.0)
    assert world.diagnose().state == "localized"


def silent(topic: str, cause: str, heard: bool = False) -> Silence:
    return Silence(topic, 7.0, heard, cause, mismatch=False)


NOBODY = silent("/camera_info", "it has no publisher")
RIVAL = {"oddities": {"second_broadcaster": "it is 4.7 m off"}}
NO_FRAME = {"silence": {"correspondences": silent("/c", "no publisher", heard=True)}}
NO_FRAME_SAID = "no frame has come for 7 s; /c: no publisher"
NO_INFO = {"missing": ("camera_info",), "silence": {"camera_info": NOBODY, "keypoints": FRAMES}}
NO_INFO_SAID = "waiting for camera_info; /camera_info: it has no publisher"


@pytest.mark.parametrize(
    ("change", "level", "state", "message"),
    [
        ({"life_cycle": "inactive"}, Level.OK, "inactive", "the node is inactive: activate it"),
        ({"life_cycle": "inactive"} | RIVAL, Level.OK, "inactive", "the node is inactive"),
        # Frames come, so that the other one is what is wrong.
        (NO_INFO, Level.ERROR, "waiting for camera_info", NO_INFO_SAID),
        (
            {
                "missing": ("camera_info", "map_points"),
                "silence": {"camera_info": COMES, "correspondences": silent("/c", "")},
            },
            Level.WARN, "waiting for camera_info and a map", "waiting for camera_info and a map",
        ),
        (NO_FRAME, Level.STALE, "waiting for frames", NO_FRAME_SAID),
        # One of two frame topics is enough.
        (
            {"silence": {"correspondences": FRAMES, "keypoints": silent("/k", "no publisher")}},
            Level.OK, "localized", "localized with 3 of 4 points",
        ),
        # What is odd though there are poses.
        ({"correction": Decision(CorrectionState(), Standing.CONTRADICTED)}, Level.ERROR,
         "localized", "map -> odom is contradicted"),
        ({"correction": Decision(CorrectionState(), Standing.HELD)}, Level.OK, "localized", ""),
        ({"oddities": {"pixels_outside": "7 of 100"}}, Level.WARN, "localized",
         "pixels_outside: 7 of 100"),
        (RIVAL, Level.ERROR, "localized", "it is 4.7 m off"),
        # A rival of a transform that a click has begun, or that is held, while nothing is seen.
        (NO_FRAME | RIVAL, Level.ERROR, "waiting for frames",
         f"{NO_FRAME_SAID}; it is 4.7 m off"),
        (NO_INFO | RIVAL, Level.ERROR, "waiting for camera_info",
         f"{NO_INFO_SAID}; it is 4.7 m off"),
    ],
)  # fmt: skip
def test_what_is_missing_or_odd_comes_first(world, change, level, state, message):
    world.pass_frames(3, rate=50.0)
    health = world.diagnose(replace(GOOD, **change))
    assert (health.level, health.values["State"]) == (level, state)
    assert health.message.startswith(message)


def test_integrity_joins_its_pose():
    localized = SimpleNamespace(
        stamp_ns=5 * 10**9 + 7, map_frame="map", body_frame="base_link",
        estimate=SimpleNamespace(integrity=0.00312),
    )  # fmt: skip
    message = integrity_message(localized)
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == (5, 7)
    (status,) = message.status
    assert {item.key: item.value for item in status.values} == {"integrity": "0.003120"}
    assert status.level == b"\x00"
    localized.estimate.integrity = 0.6
    assert integrity_message(localized).status[0].level == b"\x01"
