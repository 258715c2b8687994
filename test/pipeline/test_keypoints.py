# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""From keypoints to a pose: maps that are late, missing, replaced or unfit, and what is said."""

from typing import Any

import numpy as np
import pytest

import rs_localizer.matching
from benchmarks.fuzzing import map_rows
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import make_message
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import make_cloud, read_keypoints, read_map
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.outputs import Localized
from rs_localizer.matching import Matcher
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import (
    FrameSettings,
    SimulatedFrame,
    simulate_frames,
)
from rs_localizer.tools.simulation.simulated_recording import keypoint_rows, random_descriptors
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

READOUT_TIME = 0.03
POINTS = room(np.zeros((1, 3)), np.random.default_rng(0), count=4000)
IDS = np.random.default_rng(1).permutation(100_000)[:4000]
LANDMARKS = Map(POINTS, IDS, random_descriptors(4000, np.random.default_rng(2)), "map")


@pytest.fixture(scope="module")
def frames() -> list[SimulatedFrame]:
    camera = Camera(
        640,
        480,
        np.array([[500.0, 0.0, 319.5], [0.0, 510.0, 239.5], [0.0, 0.0, 1.0]]),
        readout_time=READOUT_TIME,
    )
    motion = ConstantVelocity(np.array([0.5, -1.0, 1.0]), np.array([0.5, 0.5, -0.5]), 0.4)
    seen = FrameSettings(points=70, noise=0.5, outliers=0.3)
    return list(simulate_frames(camera, motion, POINTS, seen))[1:]  # a stamp of 0 is none


def keypoints(frame: SimulatedFrame, *names: str, landmarks: Map = LANDMARKS) -> Any:
    rows = keypoint_rows(frame, landmarks, np.random.default_rng(frame.stamp_ns))
    chosen = rows[["u", "v", *names]]
    packed = np.empty(len(rows), [(n, rows.dtype[n]) for n in chosen.dtype.names or ()])
    for name in packed.dtype.names or ():
        packed[name] = rows[name]
    return make_cloud(make_message, frame.stamp_ns, "camera", packed)


def map_cloud(landmarks: Map) -> Any:
    return make_cloud(make_message, 0, landmarks.frame, map_rows(landmarks))


class Notices(list[tuple[str, str]]):
    def __call__(self, *words: str) -> None:
        self.append((words[0], words[1]))


def localizer(
    make_camera_info: Any, notices: Notices | None = None, **settings: Any
) -> CameraFrames:
    given = NodeConfig(**{"readout_time": READOUT_TIME, **settings})
    result = CameraFrames(given, Notices() if notices is None else notices)
    result.calibrate(read_camera_info(make_camera_info()))
    return result


def refused(result: Localized | Refusal) -> tuple[str, str]:
    assert isinstance(result, Refusal), result
    return result.reason, result.detail


def localized(result: Localized | Refusal, truth: SimulatedFrame) -> Localized:
    assert result, result
    assert np.allclose(result.pose.position, truth.first_row.positions[0], atol=0.02)
    return result


@pytest.mark.parametrize("tracking", [True, False])
@pytest.mark.parametrize("names", [("id",), ("descriptor",), ("id", "descriptor")])
def test_the_true_pose(frames, make_camera_info, names, tracking):
    node = localizer(make_camera_info, tracking=tracking)
    node.landmarks.use_map(read_map(map_cloud(LANDMARKS)))
    for frame in frames:
        result = localized(node.localize_keypoints(keypoints(frame, *names)), frame)
        assert result.map_frame == "map"
        assert result.body_frame == "camera"
        good = frame.inliers.sum()
        assert 0.8 * good < len(result.inliers) <= good + 2
        # The inliers are rows of the map, with the pixels that came.
        rows = {int(number): k for k, number in enumerate(IDS)}
        for inlier in result.inliers[:20]:
            point = POINTS[rows[int(inlier["id"])]]
            assert [inlier[name] for name in "xyz"] == point.astype(np.float32).tolist()
            assert inlier["u"] in frame.pixels[:, 0].astype(np.float32)
        assert result.estimate.tracked == (tracking and frame is not frames[0])


def test_keypoints_that_give_no_pose(frames, make_camera_info):
    node = localizer(make_camera_info)
    node.landmarks.use_map(read_map(map_cloud(LANDMARKS)))
    wide = Map(POINTS, None, random_descriptors(4000, np.random.default_rng(0), 64), "map")
    strangers = Map(POINTS, IDS + 200_000, None, "map")
    unfit = (
        ("id", LANDMARKS, 0, "empty_cloud", ""),
        ("id", LANDMARKS, 10**6, "bad_keypoints", "truncated"),
        ("descriptor", wide, None, "bad_keypoints",
         "the keypoints have descriptors of 64 x uint8, the map has descriptors of 32 x uint8"),
        ("id", strangers, None, "no_matches",
         "none of 70 keypoints matches one of 4000 landmarks by id"),
        ("id", LANDMARKS, 5, "too_few_points", ""),
    )  # fmt: skip
    for frame, (name, landmarks, width, reason, detail) in zip(frames, unfit, strict=False):
        message = keypoints(frame, name, landmarks=landmarks)
        message.width = message.width if width is None else width
        said = refused(node.localize_keypoints(message))
        assert said[0] == reason
        assert detail in said[1]
    unknown = CameraFrames(NodeConfig())
    unknown.landmarks.use_map(read_map(map_cloud(LANDMARKS)))
    assert refused(unknown.localize_keypoints(keypoints(frames[0], "id")))[0] == "no_camera_info"
    # None of this left a trace.
    localized(node.localize_keypoints(keypoints(frames[5], "id")), frames[5])


@pytest.mark.parametrize("names", [("id",), ("descriptor",)])
def test_keypoints_that_repeat_are_an_image_that_does(frames, make_camera_info, names):
    """Matched near a prediction, the same keypoints would not give the same matches."""
    node = localizer(make_camera_info)
    node.landmarks.use_map(read_map(map_cloud(LANDMARKS)))
    messages = [keypoints(frame, *names) for frame in frames[:6]]
    for k in (3, 4):  # hung
        stamp = messages[k].header.stamp
        messages[k] = keypoints(frames[2], *names)
        messages[k].header.stamp = stamp
    found = [node.localize_keypoints(message) for message in messages]
    assert [bool(result) for result in found] == [True, True, True, False, False, True]
    assert {found[3].reason, found[4].reason} == {"repeated_image"}
    # Another map is matched anew.
    assert node.landmarks.repeated(read_keypoints(messages[5])) is not None
    node.landmarks.use_map(Map(POINTS + 1.0, IDS, LANDMARKS.descriptors, "map"))
    assert node.landmarks.repeated(read_keypoints(messages[5])) is None


def test_a_wrong_prediction_is_found_out(frames, make_camera_info, monkeypatch):
    """The camera is carried elsewhere between two frames: nothing is where it is predicted."""
    asked: list[bool] = []

    class Asked(Matcher):
        def match(self, *arguments: Any) -> Any:
            asked.append(arguments[2] is not None)
            return super().match(*arguments)

    monkeypatch.setattr(rs_localizer.matching, "Matcher", Asked)
    node = localizer(make_camera_info)
    node.landmarks.use_map(read_map(map_cloud(LANDMARKS)))
    for frame in frames[:3]:
        localized(node.localize_keypoints(keypoints(frame, "descriptor")), frame)
    assert asked == [False, True, True]
    away = Map(
        POINTS @ np.array([[0, 0, 1.0], [0, 1, 0], [-1, 0, 0]]), None, LANDMARKS.descriptors, "map"
    )
    node.landmarks.use_map(read_map(map_cloud(away)))
    asked.clear()
    for frame in frames[3:5]:
        result = node.localize_keypoints(keypoints(frame, "descriptor"))
        assert result, result
        assert len(result.inliers) > 40
    assert asked == [True, False, True]


def test_coordinates_far_from_the_origin_keep_their_digits(frames, make_camera_info):
    away = np.array([4e6, 5e5, 100.0])
    node = localizer(make_camera_info)
    utm = Map(POINTS + away, IDS, LANDMARKS.descriptors, "utm")
    node.landmarks.use_map(read_map(map_cloud(utm)))
    for frame in frames[:3]:
        result = node.localize_keypoints(keypoints(frame, "descriptor"))
        assert result, result
        assert np.allclose(result.pose.position - away, frame.first_row.positions[0], atol=0.02)
        assert result.inliers["x"].dtype == np.float64
