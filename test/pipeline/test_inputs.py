# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The list of inputs, and what is derived from it."""

import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rs_localizer
from rs_localizer.config import NodeConfig
from rs_localizer.core.reasons import Reason
from rs_localizer.io.bags import BagError, BagReader
from rs_localizer.offline.replay import NO_FRAMES, camera_topics, find_rig_topics, find_topics
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.inputs import INPUTS, Role
from rs_localizer.pipeline.refusal import Refusal

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
