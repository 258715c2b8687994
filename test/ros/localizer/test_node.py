# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node as its users meet it: its own process, DDS, signals, parameters, life cycle, rates."""

import os
import re
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from rosgraph_msgs.msg import Clock

from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import typestore
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.maps.files import write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import TYPES
from rs_localizer.pipeline.camera_frames import CameraFrames

from ..conftest import RUN  # noqa: TID252 - Python has a package "test"
from .robot import READOUT_TIME, SHUTTER, Robot, inputs, record, replayed


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    """A flight with a calibration that is off."""
    path = tmp_path_factory.mktemp("bags") / "flight"
    record(path, 0.9)
    return path


def test_node_and_replay_say_the_same_to_the_last_byte(recording, tmp_path, start_node, peer):
    """At mid-frame (the other moment is in test_frames.py); then with other parameters."""
    settings = [*SHUTTER, "-p", "pose_time:=mid_frame", "-p", "solver:=joint"]
    offline = replayed(recording, tmp_path / "out", *settings)
    node = start_node(*settings)
    robot = Robot(peer)
    robot.connect()
    for info, cloud in inputs(recording):
        robot.localize(info, cloud)
    # Diagnostics come once a second and tell of the last frame alone, here with 0.6 px.
    assert peer.spin_until(lambda: robot.values.get("Frames answered") == "12")
    assert float(robot.values["Model error (px)"]) > 0.3
    for name in TYPES:
        assert len(offline[name]) == 12
        assert robot.answered(name) == offline[name]

    def twists_of_one_more() -> int:
        before = len(robot.answers["odometry"])
        cloud.header.stamp.sec += 1  # a repeated stamp is refused, and so is a repeated image
        cloud.data = cloud.data[cloud.point_step :] + cloud.data[: cloud.point_step]
        robot.localize(None, cloud)
        return len(robot.answers["odometry"]) - before

    changes = {"solver": "p3p", "inlier_threshold": 10.0, "pose_time": "stamp"}
    request = SetParametersAtomically.Request(
        parameters=[
            Parameter(name, value=value).to_parameter_msg() for name, value in changes.items()
        ]
    )
    service = "/rs_localizer/set_parameters_atomically"
    assert peer.call(SetParametersAtomically, service, request).result.successful
    # A setting is answered before frames have it: the worker takes it between two frames.
    assert peer.spin_until(lambda: twists_of_one_more() == 0)  # p3p knows none
    assert robot.set("solver", "r6p_vcwt") == robot.set("readout_time", 0.0) == (True, "")
    assert peer.spin_until(lambda: twists_of_one_more() == 0)
    assert robot.set("readout_time", READOUT_TIME) == (True, "")
    assert peer.spin_until(lambda: twists_of_one_more() > 0)
    assert node.stop() == 0


def test_a_lens_that_cannot_be_used_and_a_second_node_are_said(recording, start_node, peer):
    """Poses go on with the last lens, and each frame would have two poses."""
    node, robot = start_node(*SHUTTER), Robot(peer)
    robot.connect()
    for k, (info, cloud) in enumerate(inputs(recording)[:4]):
        info.k = info.k if k < 2 else np.zeros(9)
        robot.localize(info, cloud)
    assert peer.spin_until(lambda: "Notice: bad_camera_info" in robot.odd)
    assert "Notice: two_publishers" not in robot.odd
    peer.node.create_publisher(PoseStamped, "/rs_localizer/pose", 1)
    assert peer.spin_until(lambda: "Notice: two_publishers" in robot.odd)
    assert len(robot.answers["pose"]) == 4
    assert node.stop() == 0


def test_life_cycle_of_a_node_with_other_names(recording, start_node, peer, tmp_path):
    """It waits to be configured, its namespace is another, and a QoS is overridden."""
    override = "qos_overrides./cam/correspondences.subscription.reliability:=best_effort"
    words = ("-p", "autostart:=false", "-r", "__ns:=/cam", "-p", override)
    node = start_node(*words, *SHUTTER)
    robot = Robot(peer, namespace="/cam")

    def state() -> int:
        answer = peer.call(GetState, "/cam/rs_localizer/get_state", GetState.Request())
        return int(answer.current_state.id)

    def change(transition: int) -> bool:
        request = ChangeState.Request(transition=Transition(id=transition))
        # The first one comes when it cannot be activated yet.
        none = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
        service = "/cam/rs_localizer/change_state"
        return bool(peer.call(ChangeState, service, request, harmless=none).success)

    def listeners() -> int:
        return int(peer.node.count_subscribers("/cam/correspondences"))

    assert state() == State.PRIMARY_STATE_UNCONFIGURED
    # What is fixed can be set as long as it is unconfigured.
    assert robot.set("map_file", str(tmp_path / "no.npz"))[0]
    assert not change(Transition.TRANSITION_CONFIGURE)
    node.wait_for_log("not configured: map_file: ")
    write_npz(tmp_path / "map.npz", Map(np.eye(3), np.arange(3), None, "map"))
    for name, value in (("map_file", str(tmp_path / "map.npz")), ("map_frame", "hall")):
        assert robot.set(name, value)[0]
    # Two clients at once: the transition is made once, and both get an answer.
    clients = [
        peer.node.create_client(ChangeState, "/cam/rs_localizer/change_state") for _ in range(2)
    ]
    assert peer.spin_until(lambda: all(client.service_is_ready() for client in clients))
    request = ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE))
    for client in clients:  # answers reach a client that the service knows
        while not peer.spin_until(client.call_async(request).done, 5.0):
            pass
    request.transition.id = Transition.TRANSITION_CONFIGURE
    answers = [client.call_async(request) for client in clients]
    assert peer.spin_until(lambda: all(answer.done() for answer in answers))
    assert sorted(answer.result().success for answer in answers) == [False, True]
    # By us; from Kilted on by rclpy.
    assert re.search(
        r"refused: the node is inactive|from current state \(2, 'inactive'\)", node.log
    )
    assert "the map has 3 landmarks in frame 'hall'" in node.log
    assert (state(), listeners()) == (State.PRIMARY_STATE_INACTIVE, 0)
    refused = "map_frame cannot be changed while the node is inactive: clean it up first"
    assert robot.set("map_frame", "cellar") == (False, refused)
    assert robot.set("map_frame", "hall")[0]  # as it is

    assert change(Transition.TRANSITION_ACTIVATE)
    robot.connect()
    info, cloud = inputs(recording)[0]
    robot.localize(info, cloud)

    def reliability(topic: str, infos: Any) -> Any:
        others = [info for info in infos(topic) if info.node_name != "peer"]
        return others[0].qos_profile.reliability if others else None

    subscriptions = peer.node.get_subscriptions_info_by_topic
    # Where nothing is overridden, that of the publisher.
    reliable = ReliabilityPolicy.RELIABLE
    assert peer.spin_until(lambda: reliability("/cam/camera_info", subscriptions) == reliable)
    assert reliability("/cam/correspondences", subscriptions) == ReliabilityPolicy.BEST_EFFORT
    for name in TYPES:
        topic = f"/cam/rs_localizer/{name}"
        assert reliability(topic, peer.node.get_publishers_info_by_topic) == reliable

    assert change(Transition.TRANSITION_DEACTIVATE)
    assert peer.spin_until(lambda: listeners() == 0)
    before = len(robot.answers["inliers"])
    robot.send(info, cloud)
    assert not peer.spin_until(lambda: len(robot.answers["inliers"]) > before, 0.3)
    assert change(Transition.TRANSITION_CLEANUP)
    assert peer.spin_until(lambda: peer.node.count_publishers("/cam/rs_localizer/pose") == 0)
    assert robot.set("map_file", "")[0]
    # Once more from the start.
    assert change(Transition.TRANSITION_CONFIGURE)
    assert change(Transition.TRANSITION_ACTIVATE)
    robot.connect()
    robot.localize(info, cloud)
    assert change(Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state() == State.PRIMARY_STATE_FINALIZED
    assert node.stop() == 0
    for word in ("Traceback", "ignored", "readout_time is 0"):
        assert word not in node.log


def test_a_signal_while_a_frame_takes_long(recording, start_node, peer):
    slow = (
        "import sys, time; from rs_localizer.pipeline.camera_frames import CameraFrames as F\n"
        "def wait(self, message): print('a slow frame', flush=True); time.sleep(9999)\n"
        "F.localize = wait\n"
        "from rs_localizer.ros.main import main; sys.exit(main())"
    )
    node = start_node(*SHUTTER, run=slow)
    robot = Robot(peer)
    robot.connect()
    while "a slow frame" not in node.log:
        robot.send(*inputs(recording)[0])
        peer.spin_until(lambda: False, 0.1)
    assert node.stop(signal.SIGTERM, signal.SIGTERM) == 0
    assert "Traceback" not in node.log


# The frame after the flight takes for ever.
SLOW = """
import time; from rs_localizer.pipeline.camera_frames import CameraFrames as F
localize, count = F.localize, iter(range(1000))
def wait(self, message):
    if next(count) == {frames}: print('a slow frame', flush=True); time.sleep(9999)
    return localize(self, message)
F.localize = wait
"""


def test_odometry_between_and_after_images(tmp_path, start_node, peer):
    """By a simulated clock: 25 ms after each image, while one is localized, and then no more."""
    record(tmp_path / "flight")
    flight = inputs(tmp_path / "flight")
    offline = CameraFrames(NodeConfig(readout_time=READOUT_TIME))
    words = (*SHUTTER, "-p", "output_rate:=50.0", "-p", "use_sim_time:=true")
    node = start_node(*words, run=SLOW.format(frames=len(flight)) + RUN)
    robot = Robot(peer)
    clock = peer.node.create_publisher(Clock, "/clock", 10)
    robot.connect()

    def said() -> dict[int, Any]:
        kind = TYPES["odometry"]
        found = [typestore().deserialize_cdr(d, kind) for d in robot.answers["odometry"]]
        assert [stamp_ns(one) for one in found] == sorted({stamp_ns(one) for one in found})
        return {stamp_ns(one): one for one in found}

    def turn_to(time_ns: int) -> None:
        message = Clock()
        message.clock.sec, message.clock.nanosec = divmod(time_ns, 10**9)
        clock.publish(message)

    def compare(time_ns: int) -> bool:
        expected = offline.at(time_ns)
        if expected is None:  # one frame alone is no motion yet
            return False
        turn_to(time_ns)
        assert peer.spin_until(lambda: time_ns in said())
        place = said()[time_ns].pose.pose.position
        np.testing.assert_allclose([place.x, place.y, place.z], expected.pose.position, atol=1e-9)
        return True

    compared = []
    for info, cloud in flight:
        robot.localize(info, cloud)
        offline.calibrate(read_camera_info(info))
        assert offline.localize(cloud)
        compared.append(compare(stamp_ns(cloud) + 25_000_000))
    assert sum(compared) >= 10
    cloud.header.stamp.nanosec += 10_000_000
    while "a slow frame" not in node.log:
        robot.send(None, cloud)
        peer.spin_until(lambda: False, 0.2)
    last_ns, count = stamp_ns(cloud), len(said())
    assert all(compare(last_ns + later * 1_000_000) for later in (30, 50, 70))
    assert len(robot.answers["inliers"]) == len(flight)
    turn_to(last_ns + 300_000_000)  # beyond max_prediction
    assert not peer.spin_until(lambda: len(said()) > count + 3, 0.5)


# A module that tells that it is being imported, and takes its time.
SLOW_IMPORT = (
    "import pathlib, time; pathlib.Path(__file__).with_suffix('.seen').touch(); time.sleep(9999)"
)


def test_signals_while_it_imports(start_node, tmp_path):
    (tmp_path / "rclpy.py").write_text(SLOW_IMPORT)
    node = start_node(PYTHONPATH=f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}")
    while not (tmp_path / "rclpy.seen").exists():
        assert node.process.poll() is None, node.log
        time.sleep(0.02)
    assert node.stop(signal.SIGTERM) == 0
    assert node.log == ""


def test_started_with_bad_parameters(start_node):
    node = start_node("--params-file", "/nowhere.yaml")
    assert node.process.wait() == 1
    fatal = [line for line in node.log.splitlines() if line.startswith("[FATAL]")]
    assert len(fatal) == 1
    assert "/nowhere.yaml" in fatal[0]
    assert "Traceback" not in node.log


def test_an_end_that_the_middleware_holds_up_is_cut_short(start_node):
    """Launch files kill what has not ended after five seconds."""
    node = start_node(
        run="import rclpy, sys, time; rclpy.try_shutdown = lambda: time.sleep(9999);"
        "from rs_localizer.ros.main import main; sys.exit(main())"
    )
    node.wait_for_log("active with solver")
    assert node.stop(signal.SIGTERM) == 0
    assert "did not end within 4 s" in node.log
    assert "in run" in node.log


def test_what_it_says_at_start_and_an_end_by_signals(start_node, tmp_path):
    file = tmp_path / "params.yaml"
    file.write_text("/**:\n  ros__parameters: {min_inlier: 9, use_sim_time: false}\n")
    node = start_node("--params-file", str(file), "-p", "readout_tim:=0.1")
    node.wait_for_log("active with solver")
    lines = [line.partition("]: ")[2] for line in node.log.splitlines()]
    ignored = "a parameter is ignored: {} is not a setting; did you mean {}?"
    assert [line for line in lines if "ignored" in line] == [
        ignored.format("'min_inlier'", "min_inliers"),
        ignored.format("'readout_tim'", "readout_time"),
    ]
    silent = "readout_time is 0 (unknown): no twist is published and frames are not tracked"
    assert lines.count(silent) == 1
    assert node.stop(signal.SIGINT, signal.SIGINT, signal.SIGTERM, signal.SIGTERM) == 0
    assert "Traceback" not in node.log
    assert "rror" not in node.log
