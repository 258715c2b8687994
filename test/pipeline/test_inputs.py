# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The list of inputs and what is derived from it; what is odd about a frame; streams."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

import rs_localizer
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera, Roi
from rs_localizer.core.reasons import Reason
from rs_localizer.io.bags import BagError, BagReader
from rs_localizer.io.clouds import Correspondences
from rs_localizer.offline.replay import NO_FRAMES, camera_topics, find_rig_topics, find_topics
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.cloud_checks import oddities, stale_landmarks
from rs_localizer.pipeline.inputs import INPUTS, Role
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.pipeline.stream import Stream

INFO, CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"


def bag(**topics: str) -> Any:
    connections = [SimpleNamespace(topic=f"/{it}", msgtype=kind) for it, kind in topics.items()]
    return BagReader(Path("bag"), SimpleNamespace(connections=connections))


@pytest.mark.parametrize("name", INPUTS)
def test_a_message_that_cannot_be_read_is_refused_for_a_known_reason(name, tmp_path):
    item = INPUTS[name]
    nameless = SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id="")
    sizes = dict.fromkeys(("height", "width", "point_step", "row_step", "is_bigendian"), 1)
    broken = SimpleNamespace(header=nameless, fields=[], data=b"", **sizes)
    wall = tmp_path / "wall.yaml"
    wall.write_text(
        "{map_frame: map, markers: [{family: 4x4_50, id: 0, size: 0.1, position: [0, 0, 0], "
        "quaternion: [0, 0, 0, 1]}]}"
    )
    localizer = CameraFrames(NodeConfig(marker_map=str(wall)))
    localizer.load_files()
    refusal = item.take_message(localizer, broken)
    assert isinstance(refusal, Refusal)
    assert refusal.reason == item.refused
    assert (refusal.reason in NO_FRAMES) == (item.role != Role.FRAMES)


def test_topics_are_found_by_name_then_by_type():
    topics = find_topics(bag(odd=CLOUD, camera_info=INFO))
    assert topics.of == {"camera_info": "/camera_info", "correspondences": "/odd"}
    assert topics.frames == "/odd"
    named = bag(odd=CLOUD, correspondences=CLOUD, map_points=CLOUD, camera_info=INFO)
    assert find_topics(named).names == ("/camera_info", "/correspondences")
    given = find_topics(named, {"keypoints": "/odd", "camera_info": None})
    assert given.of == {
        "camera_info": "/camera_info",
        "map_points": "/map_points",
        "keypoints": "/odd",
    }


def test_what_is_not_there_or_not_clear_is_said():
    with pytest.raises(BagError, match="CameraInfo for -r camera_info:=TOPIC"):
        find_topics(bag(correspondences=CLOUD))
    with pytest.raises(BagError, match="choose with -r correspondences:=TOPIC or -r keyp"):
        find_topics(bag(correspondences=CLOUD, keypoints=CLOUD, camera_info=INFO))
    with pytest.raises(BagError, match="/camera_info is of type sensor_msgs"):
        find_topics(bag(camera_info=INFO, a=CLOUD), {"correspondences": "/camera_info"})
    with pytest.raises(BagError, match="choose one with -r correspondences:=TOPIC"):
        find_topics(bag(camera_info=INFO, a=CLOUD, b=CLOUD))


def test_cameras_of_a_rig_send_one_kind_of_frames():
    there = {"a/front/camera_info": INFO, "a/front/keypoints": CLOUD, "map_points": CLOUD}
    pair = {**there, "rear/camera_info": INFO, "rear/correspondences": CLOUD}
    alone = {"front/camera_info": "/a/front/camera_info", "front/keypoints": "/a/front/keypoints"}
    assert find_rig_topics(bag(**there), ["front"]).of == alone | {"map_points": "/map_points"}
    with pytest.raises(BagError, match="all cameras need correspondences, or all keypoints"):
        find_rig_topics(bag(**pair), ["front", "rear"])
    with pytest.raises(BagError, match="images of left; it has those of front, rear"):
        find_rig_topics(bag(**pair), ["front", "left"])
    with pytest.raises(BagError, match="keypoints or images of another"):
        camera_topics(bag(**there))


PACKAGE = Path(rs_localizer.__file__).parent


def test_every_reason_is_given_somewhere():
    others = (path for path in PACKAGE.rglob("*.py") if path.name != "reasons.py")
    given = {name for path in others for name in re.findall(r"\bReason\.(\w+)", path.read_text())}
    assert {reason.name for reason in Reason} == given


K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K)
PART = Camera(640, 480, K, binning=(2, 2), roi=Roi(100, 60, 400, 300))


def cloud(
    largest: float = 5.0,
    kind: str = "<f4",
    pixel: tuple[float, float] = (639.4, -0.4),
    frame: str = "map",
) -> Correspondences:
    points = np.array([[0.0, 1.0, 2.0], [1.0, -largest, 3.0]])
    pixels = np.array([(320.0, 240.0), pixel])
    table = np.zeros(2, [(name, kind) for name in "xyz"])
    return Correspondences(0, frame, points, pixels, None, 0, table)


@pytest.mark.parametrize(
    ("odd", "told", "figures"),
    [
        ({"largest": 8000.0}, None, ()),
        ({"largest": 9000.0}, "coarse_coordinates", ("9000 m", "1 mm")),
        ({"largest": 500e3}, "coarse_coordinates", ("500000 m", "31 mm")),
        ({"largest": 4e6, "kind": "<f8"}, None, ()),
        ({"pixel": (640.2, 480.1)}, None, ()),  # a tracker's slack
        ({"pixel": (1200.0, 700.0)}, "pixels_outside", ("1 of 2", "640 x 480", "(1200, 700)")),
        ({"pixel": (300.0, 100.0), "of": PART}, "pixels_outside", ("2 of 2", "200 x 150")),
    ],
)
def test_coarse_coordinates_and_pixels_of_another_resolution_are_told(odd, told, figures):
    camera = odd.pop("of", CAMERA)
    found = oddities(cloud(**odd), camera, "camera", 20_000)
    assert list(found) == ([] if told is None else [told])
    assert all(figure in found[told] for figure in figures)


def test_landmarks_that_are_gone_are_named():
    both, none = np.ones(2, np.bool_), np.zeros(2, np.bool_)
    assert stale_landmarks(cloud(), none) == ""
    assert stale_landmarks(cloud(), both).endswith(": (0.00, 1.00, 2.00), (1.00, -5.00, 3.00)")
    table = np.zeros(40, [("id", "<u4")])
    table["id"] = np.arange(40) // 4  # corners of markers
    seen = Correspondences(0, "map", np.zeros((40, 3)), np.zeros((40, 2)), None, 0, table)
    assert stale_landmarks(seen, table["id"] > 7).endswith("matched: 8, 9")
    assert stale_landmarks(seen, table["id"] > 7, "abcdefghij").endswith("matched: i, j")
    seen.table["id"] = 2 * np.arange(40)
    assert stale_landmarks(seen, np.ones(40, np.bool_)).endswith(" 20, 22 ...")


SECOND = 10**9


class Heard:
    def __init__(self) -> None:
        self.told: list[tuple[str, str]] = []
        self.forget = Mock()
        self.stream = Stream(lambda *words: self.told.append(words), self.forget)

    @property
    def notices(self) -> list[str]:
        return [name for name, _ in self.told]

    def reason(self, seconds: float, frame: str = "map") -> Any:
        refusal = self.stream.follow(round(seconds * SECOND), frame)
        return None if refusal is None else refusal.reason


def test_stamps_out_of_order():
    heard = Heard()
    assert [heard.reason(s) for s in (5.0, 5.1, 5.1, 5.05, 5.2, 4.71)] == [
        None, None, "repeated_stamp", "late_frame", None, "late_frame",
    ]  # fmt: skip
    assert (heard.forget.call_count, heard.notices) == (0, [])
    # Half a second and more is a recording that starts over.
    assert heard.reason(4.7) is None
    assert (heard.forget.call_count, heard.notices) == (1, ["time_went_back"])
    assert heard.reason(4.7, "other") is None
    assert (heard.forget.call_count, heard.notices[1:]) == (2, ["map_changed"])
    heard.stream.reset()
    assert heard.reason(4.7, "other") is None
