# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node as its users meet it: its own process, real DDS, signals, parameters, life cycle."""

import re
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy

from rs_localizer.io.maps.files import write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.outputs import TYPES

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
