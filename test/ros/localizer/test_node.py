# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node as its users meet it: its own process, real DDS, signals, parameters, life cycle."""

import signal
from pathlib import Path
from typing import Any

import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import ReliabilityPolicy
from robot import READOUT_TIME, SHUTTER, Robot, inputs, record, replayed

from rs_localizer.io.outputs import TYPES


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("bags") / "flight")


def state(peer: Any) -> int:
    return int(peer.call(GetState, "/rs_localizer/get_state", GetState.Request()).current_state.id)


def change_state(peer: Any, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(peer.call(ChangeState, "/rs_localizer/change_state", request).success)


def test_node_and_replay_say_the_same_to_the_last_byte(tmp_path, start_node, peer):
    """With a calibration that is off, at mid-frame; the other moment is in test_frames.py."""
    recording = record(tmp_path / "flight", 0.7)
    settings = [*SHUTTER, "-p", "pose_time:=mid_frame", "-p", "solver:=joint"]
    offline = replayed(recording, tmp_path / "out", *settings)
    start_node(*settings)
    robot = Robot(peer)
    robot.connect()
    for info, cloud in inputs(recording):
        robot.localize(info, cloud)
    assert robot.peer.spin_until(lambda: float(robot.values.get("Lens error (px)", "0")) > 1.0)
    for name in TYPES:
        assert len(offline[name]) == 12
        assert robot.answered(name) == offline[name]


def test_parameters_of_a_running_node(recording, start_node, peer):
    node = start_node()
    robot = Robot(peer)
    robot.connect()
    info, cloud = inputs(recording)[0]
    robot.localize(info, cloud)
    assert robot.answers["odometry"] == []
    assert robot.set("readout_time", READOUT_TIME) == (True, "")
    robot.localize(None, cloud)
    assert len(robot.answers["odometry"]) > 0
    changes = [
        Parameter("solver", value="p3p").to_parameter_msg(),
        # A single pose fits this motion badly.
        Parameter("inlier_threshold", value=10.0).to_parameter_msg(),
        Parameter("pose_time", value="mid_frame").to_parameter_msg(),
    ]
    request = SetParametersAtomically.Request(parameters=changes)
    service = "/rs_localizer/set_parameters_atomically"
    assert peer.call(SetParametersAtomically, service, request).result.successful
    before = len(robot.answers["odometry"])
    robot.localize(None, cloud)
    assert len(robot.answers["odometry"]) == before  # p3p knows no twist
    assert node.stop() == 0


def test_life_cycle(recording, start_node, peer):
    node = start_node("-p", "autostart:=false", *SHUTTER)
    info, cloud = inputs(recording)[0]
    assert state(peer) == State.PRIMARY_STATE_UNCONFIGURED
    robot = Robot(peer)
    assert peer.node.count_subscribers("/correspondences") == 0
    assert change_state(peer, Transition.TRANSITION_CONFIGURE)
    assert state(peer) == State.PRIMARY_STATE_INACTIVE
    assert peer.node.count_subscribers("/correspondences") == 0
    assert change_state(peer, Transition.TRANSITION_ACTIVATE)
    robot.connect()
    robot.localize(info, cloud)
    assert change_state(peer, Transition.TRANSITION_DEACTIVATE)
    assert peer.spin_until(lambda: peer.node.count_subscribers("/correspondences") == 0)
    assert not robot.send(info, cloud, 0.3)
    assert change_state(peer, Transition.TRANSITION_CLEANUP)
    assert peer.spin_until(lambda: peer.node.count_publishers("/rs_localizer/pose") == 0)
    # Once more from the start.
    assert change_state(peer, Transition.TRANSITION_CONFIGURE)
    assert change_state(peer, Transition.TRANSITION_ACTIVATE)
    robot.connect()
    robot.localize(info, cloud)
    assert change_state(peer, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state(peer) == State.PRIMARY_STATE_FINALIZED
    assert node.stop() == 0
    assert "Traceback" not in node.log
    assert "ignored" not in node.log
    assert "readout_time is 0" not in node.log


def test_what_is_fixed_can_be_set_while_it_is_unconfigured(start_node, peer, tmp_path):
    node = start_node("-p", "autostart:=false")
    robot = Robot(peer)
    assert robot.set("map_file", str(tmp_path / "no.npz"))[0]
    assert not change_state(peer, Transition.TRANSITION_CONFIGURE)
    node.wait_for_log("not configured: map_file: ")
    for name, value in (("map_file", ""), ("map_frame", "hall"), ("odom_frame", "wheels")):
        assert robot.set(name, value)[0]
    assert change_state(peer, Transition.TRANSITION_CONFIGURE)
    refused = "map_frame cannot be changed while the node is inactive: clean it up first"
    assert robot.set("map_frame", "cellar") == (False, refused)
    assert robot.set("map_frame", "hall")[0]  # as it is
    assert change_state(peer, Transition.TRANSITION_CLEANUP)
    assert robot.set("map_frame", "cellar")[0]
    assert node.stop() == 0


def test_names_can_be_remapped_and_qos_overridden(recording, start_node, peer):
    override = "qos_overrides./cam/camera_info.subscription.reliability"
    start_node("-r", "__ns:=/cam", "-p", f"{override}:=best_effort", *SHUTTER)
    robot = Robot(peer, namespace="/cam")
    robot.connect()
    robot.localize(*inputs(recording)[0])

    def reliability(topic: str, infos: Any) -> Any:
        others = [info for info in infos(topic) if info.node_name != "peer"]
        return others[0].qos_profile.reliability if others else None

    subscriptions = peer.node.get_subscriptions_info_by_topic
    # Where nothing is overridden, that of the publisher.
    reliable = ReliabilityPolicy.RELIABLE
    assert peer.spin_until(lambda: reliability("/cam/correspondences", subscriptions) == reliable)
    assert reliability("/cam/camera_info", subscriptions) == ReliabilityPolicy.BEST_EFFORT
    publishers = peer.node.get_publishers_info_by_topic
    for name in TYPES:
        assert reliability(f"/cam/rs_localizer/{name}", publishers) == ReliabilityPolicy.RELIABLE


def test_a_signal_while_a_frame_takes_long(recording, start_node, peer):
    slow = (
        "import sys, time; from rs_localizer.pipeline.frames import FrameLocalizer as F\n"
        "def wait(self, message): print('a slow frame', flush=True); time.sleep(100)\n"
        "F.localize = wait\n"
        "from rs_localizer.ros.main import main; sys.exit(main())"
    )
    node = start_node(*SHUTTER, run=slow)
    robot = Robot(peer)
    robot.connect()
    while "a slow frame" not in node.log:
        robot.send(*inputs(recording)[0], timeout=0.1)
    assert node.stop(signal.SIGTERM, signal.SIGTERM) == 0
    assert "Traceback" not in node.log
