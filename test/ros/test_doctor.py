# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The doctor finds the topics of a robot, localizes, and says what is wrong."""

import re
import time
from pathlib import Path

import pytest
import yaml
from sensor_msgs.msg import Image

from rs_localizer.ros.doctor import answer, input_of
from rs_localizer.ros.node.diagnostics import Health, Level, State

EXAMPLES = Path(__file__).parents[2] / "examples"
MATCHER = (
    f"import runpy, sys; sys.path.insert(0, {str(EXAMPLES)!r}); "
    f"runpy.run_path({str(EXAMPLES / '03_node_client.py')!r})"
)
DOCTOR = (
    "import os, sys; os.chdir({!r}); from rs_localizer.ros.main import doctor as f; sys.exit(f())"
)


@pytest.mark.parametrize(
    ("fields", "wanted"),
    [
        ("x y z u v id", "correspondences"),
        ("x y z u v residual", None),  # of a localizer
        ("u v descriptor", "keypoints"),
        ("x y z descriptor", "map_points"),
        ("x y z intensity", None),  # of a lidar
        ("u v", None),
    ],
)
def test_clouds_are_known_by_their_fields(fields, wanted):
    assert input_of(fields.split()) == wanted


def test_the_answer():
    values = {"Position deviation (cm)": "1.2"}
    well = Health(Level.OK, State.TRACKING, "tracking with 90 of 100 points", values)
    assert answer(well) == "tracking, 1.2 cm"
    odd = Health(Level.WARN, State.LOCALIZED, "map_scale: millimetres?", values)
    assert answer(odd) == "localized, 1.2 cm; map_scale: millimetres?"
    waiting = Health(Level.ERROR, State.WAITING, "waiting for camera_info")
    assert answer(waiting) == "waiting for camera_info"


def test_a_robot_with_names_of_its_own(start_node, peer, tmp_path):
    names = ("-r", "correspondences:=/matcher/matches", "-r", "camera_info:=/cam/info")
    matcher = start_node(*names, run=MATCHER)
    images = peer.node.create_publisher(Image, "/cam/image_raw", 10)
    doctor = start_node("-p", "readout_time:=0.03", run=DOCTOR.format(str(tmp_path)))
    image = Image(width=1280, height=720)
    assert peer.spin_until(lambda: images.publish(image) or doctor.process.poll() is not None)
    said = doctor.log
    assert "camera_info         /cam/info: messages arrive, reliable" in said
    assert "correspondences     /matcher/matches: messages arrive, best effort" in said
    assert "640 x 480, plumb_bob" in said
    assert "not that of the images on /cam/image_raw: 1280 x 720" in said
    assert "correspondences:=/matcher/matches" in said
    # On a busy machine it also says that frames come too fast.
    assert re.match(r"(tracking|localized), [0-9.]+ cm", said.splitlines()[-1]), said
    written = yaml.safe_load((tmp_path / "rs_localizer_doctor.yaml").read_text())
    assert written == {"/**/rs_localizer": {"ros__parameters": {"readout_time": 0.03}}}
    assert matcher.process.poll() is None


def test_a_robot_without_a_matcher(start_node, tmp_path):
    doctor = start_node(run=DOCTOR.format(str(tmp_path)))
    assert doctor.process.wait() == 1
    assert "no topic has the type sensor_msgs/msg/CameraInfo" in doctor.log
    assert "no PointCloud2 has fields u v" in doctor.log
    assert doctor.log.splitlines()[-1].startswith(("waiting for camera_info", "no frame has come"))


def test_the_matcher_of_the_examples_has_a_scene_that_nothing_is_wrong_with(start_node):
    node = start_node("-p", "readout_time:=0.03")
    node.wait_for_log("active with solver")
    client = start_node(run=MATCHER, PYTHONUNBUFFERED="1")
    while client.log.count("geometry_msgs.msg.Twist(") <= 100:
        assert client.process.poll() is None, client.log
        time.sleep(0.1)
    assert client.stop() == 0
    assert "Traceback" not in client.log
    for notice in ("doubtful", "pixels_outside", "too_few_inliers", "map_scale", "lens:"):
        assert f" {notice}" not in node.log, node.log
