# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tags of AprilRobotics' own detector: its pixels and corners, the poses that come of them."""

from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import rs_localizer.tools.simulation.walls
from rs_localizer.cli.commands import main
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import BagWriter, make_message, open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.detections import APRILTAG_TYPE, ISAAC_TYPE, read_detections
from rs_localizer.io.images import read_image
from rs_localizer.io.messages import MessageError
from rs_localizer.io.outputs import Localized
from rs_localizer.markers.detection import MarkerDetector
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.refusal import Refusal

READOUT = 0.02
FAMILY = "tag36h11"


def array(kind: str, header: Any, tags: list[tuple[str, int, np.ndarray]]) -> Any:
    """An AprilTagDetectionArray of either package; corners as they come."""
    package = kind.split("/")[0]
    point = {"isaac_ros_apriltag_interfaces": "geometry_msgs"}.get(package, package)

    def at(x: float, y: float) -> Any:
        z = {"z": 0.0} if point == "geometry_msgs" else {}
        return make_message(f"{point}/msg/Point", x=float(x), y=float(y), **z)

    def detection(family: str, number: int, corners: np.ndarray) -> Any:
        common: dict[str, Any] = {
            "family": family, "id": number, "corners": [at(*corner) for corner in corners],
        }  # fmt: skip
        middle = at(*corners.mean(axis=0))
        if package == "apriltag_msgs":
            more = {"hamming": 0, "goodness": 0.0, "decision_margin": 50.0, "centre": middle}
            more["homography"] = np.eye(3).ravel()
        else:
            geometry = "geometry_msgs/msg"
            turn = make_message(f"{geometry}/Quaternion", x=0.0, y=0.0, z=0.0, w=1.0)
            pose = make_message(f"{geometry}/Pose", position=at(0, 0), orientation=turn)
            pose = make_message(
                f"{geometry}/PoseWithCovariance", pose=pose, covariance=np.zeros(36)
            )
            pose = make_message(f"{geometry}/PoseWithCovarianceStamped", header=header, pose=pose)
            more = {"center": middle, "pose": pose}
        return make_message(f"{package}/msg/AprilTagDetection", **common, **more)

    return make_message(kind, header=header, detections=[detection(*tag) for tag in tags])


@pytest.fixture(scope="module")
def walls(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("tags") / "walls"
    words = ["--images", "--duration", "0.2", "--readout-time", str(READOUT)]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(rs_localizer.tools.simulation.walls, "_FAMILY", "apriltag_36h11")
        assert main(["simulate", str(path), *words, "--trajectory", "tum_vi_room5"]) == 0
    return path


def images(walls: Path) -> list[tuple[Any, np.ndarray]]:
    with open_bag(walls) as bag:
        (topic,) = (t for t, kind in bag.topics.items() if kind.endswith("Image"))
        return [(m.header, read_image(m).pixels) for _, _, m in bag.messages([topic])]


def of_apriltag(walls: Path) -> list[Any]:
    """What apriltag_ros publishes of the images: ``p`` of the library, copied."""
    library = pytest.importorskip("pupil_apriltags", reason="needs pupil-apriltags")
    detector = library.Detector(families=FAMILY, quad_decimate=1.0)
    found = [
        array(APRILTAG_TYPE, header,
              [(FAMILY, tag.tag_id, tag.corners) for tag in detector.detect(image)])
        for header, image in images(walls)
    ]  # fmt: skip
    # Its destructor frees families and then the detector, which uses them: a broken heap.
    detector.tag_families.clear()
    return found


def test_pixels_and_corners_are_those_of_our_own_detector(walls: Path) -> None:
    ours = MarkerDetector(read_marker_map(walls / "marker_map.yaml"))
    offsets = []
    for message, (_, image) in zip(of_apriltag(walls), images(walls), strict=True):
        found = read_detections(message)
        (seen,) = (item for item in ours.detect(image).markers if "36h11" in item.family.name)
        known = {number: own for (_, number), own in zip(found.names, found.corners, strict=True)}
        for number, quad, exact in zip(seen.ids.tolist(), seen.quads, seen.exact, strict=True):
            if number in known and exact.all():
                offsets.append(known[number] - quad)
    assert len(offsets) > 20
    apart = np.array(offsets).reshape(-1, 2)
    # Another pixel's corner would be off by 0.5 px, another corner of the tag by tens.
    assert np.abs(np.median(apart, axis=0)).max() < 0.1
    assert np.median(np.linalg.norm(apart, axis=1)) < 0.4


def camera_info(walls: Path) -> Any:
    with open_bag(walls) as bag:
        (topic,) = (t for t, kind in bag.topics.items() if kind.endswith("CameraInfo"))
        return next(iter(bag.messages([topic])))[2]


def localizer(walls: Path, notices: list[tuple[str, str]]) -> CameraFrames:
    config = NodeConfig(readout_time=READOUT, marker_map=str(walls / "marker_map.yaml"))
    made = CameraFrames(config, lambda name, text: notices.append((name, text)))
    made.load_files()
    made.calibrate(read_camera_info(camera_info(walls)))
    return made


@cache
def quads(walls: Path) -> list[tuple[Any, list[tuple[int, np.ndarray]]]]:
    """Of the first images, what our own detector finds."""
    ours = MarkerDetector(read_marker_map(walls / "marker_map.yaml"))
    return [
        (header, [it for seen in ours.detect(image).markers
                  for it in zip(seen.ids.tolist(), seen.quads, strict=True)])
        for header, image in images(walls)[:4]
    ]  # fmt: skip


def corners_of(walls: Path, order: list[int]) -> list[tuple[Any, list[Any]]]:
    """Those as tags whose corners come in this order of apriltag's."""
    return [
        (header, [(FAMILY, number, (quad[::-1] + 0.5)[order]) for number, quad in found])
        for header, found in quads(walls)
    ]


@pytest.mark.parametrize("kind", [APRILTAG_TYPE, ISAAC_TYPE])
def test_both_messages_are_read_by_their_fields(walls: Path, kind: str) -> None:
    notices: list[tuple[str, str]] = []
    made = localizer(walls, notices)
    for header, tags in corners_of(walls, [0, 1, 2, 3]):
        message = array(kind, header, [*tags, ("36h11", 500, tags[0][2])])
        result = made.localize_detections(message)
        assert isinstance(result, Localized), result
        assert set(result.inliers.dtype.names or ()) >= {"x", "u", "id", "residual"}
    assert ("unknown_markers", "the detector has found tag36h11 500, which the map does not have") \
        in notices  # fmt: skip


def test_another_order_of_corners_is_named(walls: Path) -> None:
    made = localizer(walls, [])
    results = [
        made.localize_detections(array(APRILTAG_TYPE, header, tags))
        for header, tags in corners_of(walls, [2, 3, 0, 1])
    ]
    assert not any(results)
    # Ours backwards are the message's.
    named = "lower right, lower left, upper left, upper right stand"
    assert named in results[-1].detail


def test_what_cannot_be_used_is_refused(walls: Path, tmp_path: Path, capsys: Any) -> None:
    ((header, tags), *_) = corners_of(walls, [0, 1, 2, 3])
    made = localizer(walls, [])
    for wrong, reason in (
        (array(APRILTAG_TYPE, header, []), "empty_cloud"),
        (array(APRILTAG_TYPE, header, [("tag25h9", 3, tags[0][2])]), "no_matches"),
        (array(APRILTAG_TYPE, header, [tags[0], tags[0]]), "no_matches"),
        (array(APRILTAG_TYPE, header, [(*tags[0][:2], tags[0][2] * np.nan)]), "bad_detections"),
        (SimpleNamespace(header=header), "bad_detections"),
    ):
        result = made.localize_detections(wrong)
        assert isinstance(result, Refusal)
        assert result.reason == reason
    with pytest.raises(MessageError, match="a detection has 3 corners, not 4"):
        read_detections(
            SimpleNamespace(header=header, detections=[SimpleNamespace(corners=[1, 2, 3])])
        )
    assert isinstance(CameraFrames(NodeConfig()).localize_detections(None), Refusal)
    with BagWriter(tmp_path / "tags") as bag:
        bag.write("/camera_info", camera_info(walls), 10**9)
        bag.write("/detections", array(APRILTAG_TYPE, header, tags), 2 * 10**9)
    assert main(["replay", str(tmp_path / "tags"), "--out", str(tmp_path / "out")]) == 1
    assert "-p marker_map:=FILE says where tags are" in capsys.readouterr().err
