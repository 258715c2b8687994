"""The node as its users meet it: its own process, real DDS, signals, parameters, life cycle."""

import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, PointCloud2

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, open_bag, typestore
from rs_localizer.io.outputs import TYPES
from rs_localizer.ros.node.conversion import copy_message, message_class
from rs_localizer.simulation.frames import FrameSettings, simulate_frames
from rs_localizer.simulation.recording import write_simulated
from rs_localizer.simulation.scene import room
from rs_localizer.simulation.true_motion import ConstantVelocity

READOUT_TIME = 0.03
SHUTTER = ("-p", f"readout_time:={READOUT_TIME}")
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])


def record(path: Path, known: float = 1.0) -> Path:
    """A flight, and a calibration that knows a part of the distortion."""
    distortion = np.array([-0.2, 0.05, 0.0, 0.0, 0.0])
    camera = Camera(640, 480, K, distortion, readout_time=READOUT_TIME)
    motion = ConstantVelocity(np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.4)
    world = room(np.zeros((1, 3)), np.random.default_rng(0), count=5000)
    settings = FrameSettings(points=100, noise=0.7, outliers=0.3)
    with BagWriter(path) as bag:
        for frame in simulate_frames(camera, motion, world, settings):
            write_simulated(bag, replace(camera, D=known * distortion), frame)
    return path


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("bags") / "flight")


def inputs(recording: Path) -> list[tuple[Any, Any]]:
    """Pairs of camera_info and correspondences as rclpy's messages."""
    with open_bag(recording) as bag:
        found: dict[str, list[Any]] = {"/camera_info": [], "/correspondences": []}
        for topic, _, message in bag.messages(tuple(found)):
            found[topic].append(copy_message(message, message.__msgtype__))
    return list(zip(*found.values(), strict=True))


class Talk:
    """Publishes inputs and collects outputs."""

    def __init__(self, peer: Any, inputs_prefix: str = "", node: str = "/rs_localizer") -> None:
        self.peer = peer
        self.received: dict[str, list[bytes]] = {name: [] for name in TYPES}
        reliable = QoSProfile(depth=50, reliability=ReliabilityPolicy.RELIABLE)
        create = peer.node.create_subscription
        self._subscriptions = [
            create(message_class(kind), f"{node}/{name}", self._keep(name), reliable, raw=True)
            for name, kind in TYPES.items()
        ]
        self._infos = peer.node.create_publisher(CameraInfo, f"{inputs_prefix}/camera_info", 1)
        self._clouds = peer.node.create_publisher(
            PointCloud2, f"{inputs_prefix}/correspondences", 1
        )

    def _keep(self, name: str) -> Callable[[bytes], None]:
        return lambda data: self.received[name].append(data)

    def connect(self) -> None:
        def connected() -> bool:
            listening = min(p.get_subscription_count() for p in (self._infos, self._clouds))
            topics = [subscription.topic_name for subscription in self._subscriptions]
            return bool(listening) and all(self.peer.node.count_publishers(t) for t in topics)

        assert self.peer.spin_until(connected), "the node was not found"
        time.sleep(0.2)  # the other side has to find us, too

    def send(self, info: Any, cloud: Any, timeout: float = 1.0) -> bool:
        """Send a frame; whether the node answered."""
        before = len(self.received["inliers"])
        if info is not None:
            self._infos.publish(info)
            self.peer.spin_until(lambda: False, 0.02)
        if cloud is not None:
            self._clouds.publish(cloud)
        return bool(self.peer.spin_until(lambda: len(self.received["inliers"]) > before, timeout))

    def localize(self, info: Any, cloud: Any) -> None:
        """Send a frame until the node has answered."""
        assert any(self.send(info, cloud) for _ in range(20)), "no answer"


def state(peer: Any) -> int:
    return int(peer.call(GetState, "/rs_localizer/get_state", GetState.Request()).current_state.id)


def change_state(peer: Any, transition: int) -> bool:
    request = ChangeState.Request(transition=Transition(id=transition))
    return bool(peer.call(ChangeState, "/rs_localizer/change_state", request).success)


def set_parameter(peer: Any, name: str, value: object) -> tuple[bool, str]:
    parameter = Parameter(name, value=value).to_parameter_msg()
    request = SetParameters.Request(parameters=[parameter])
    result = peer.call(SetParameters, "/rs_localizer/set_parameters", request).results[0]
    return result.successful, result.reason


@pytest.mark.parametrize(
    ("pose_time", "known"),
    [("stamp", 1.0), ("mid_frame", 1.0), ("mid_frame", 0.7)],
    ids=["stamp", "mid_frame", "a calibration that is off"],
)
def test_node_and_replay_say_the_same_to_the_last_byte(
    tmp_path, start_node, peer, pose_time, known
):
    recording = record(tmp_path / "flight", known)
    settings = [*SHUTTER, "-p", f"pose_time:={pose_time}", "-p", "solver:=joint"]
    out = tmp_path / "out"
    # In a process of its own: what other tests have compiled in this one may round differently.
    words = ["replay", str(recording), "--out", str(out), *settings]
    replayed = subprocess.run(
        [sys.executable, "-m", "rs_localizer", *words], check=True, capture_output=True, text=True
    )
    assert ("noticed: lens" in replayed.stdout) == (known < 1.0)
    start_node(*settings)
    talk = Talk(peer)
    talk.connect()
    frames = inputs(recording)
    for info, cloud in frames:
        talk.localize(info, cloud)

    def by_stamp(messages: list[Any], kind: str) -> dict[int, bytes]:
        # Sent through one serializer: DDS may pad differently.
        return {
            message.header.stamp.sec * 10**9 + message.header.stamp.nanosec: bytes(
                typestore().serialize_cdr(message, kind)
            )
            for message in messages
        }

    with open_bag(out / "result") as bag:
        for name, kind in TYPES.items():
            offline = by_stamp([m for _, _, m in bag.messages([f"/rs_localizer/{name}"])], kind)
            received = [typestore().deserialize_cdr(d, kind) for d in talk.received[name]]
            assert len(offline) == len(frames)
            assert by_stamp(received, kind) == offline


def test_parameters_of_a_running_node(recording, start_node, peer):
    node = start_node()
    talk = Talk(peer)
    talk.connect()
    info, cloud = inputs(recording)[0]
    talk.localize(info, cloud)
    assert talk.received["odometry"] == []
    assert set_parameter(peer, "readout_time", READOUT_TIME) == (True, "")
    talk.localize(None, cloud)
    assert len(talk.received["odometry"]) > 0
    for name, value, reason in (
        ("solver", "epnp", "solver must be one of"),
        ("readout_time", 1.0, "out of range"),
        ("autostart", False, "read-only"),
    ):
        successful, text = set_parameter(peer, name, value)
        assert not successful
        assert re.search(reason, text)
    # The old ones are still there and work.
    before = len(talk.received["odometry"])
    talk.localize(None, cloud)
    assert len(talk.received["odometry"]) > before
    changes = [
        Parameter("solver", value="p3p").to_parameter_msg(),
        # A single pose fits this motion badly.
        Parameter("inlier_threshold", value=10.0).to_parameter_msg(),
        Parameter("pose_time", value="mid_frame").to_parameter_msg(),
    ]
    request = SetParametersAtomically.Request(parameters=changes)
    service = "/rs_localizer/set_parameters_atomically"
    assert peer.call(SetParametersAtomically, service, request).result.successful
    before = len(talk.received["odometry"])
    talk.localize(None, cloud)
    assert len(talk.received["odometry"]) == before  # p3p knows no twist
    assert node.stop() == 0


def test_life_cycle(recording, start_node, peer):
    node = start_node("-p", "autostart:=false", *SHUTTER)
    info, cloud = inputs(recording)[0]
    assert state(peer) == State.PRIMARY_STATE_UNCONFIGURED
    talk = Talk(peer)
    assert peer.node.count_subscribers("/correspondences") == 0
    assert change_state(peer, Transition.TRANSITION_CONFIGURE)
    assert state(peer) == State.PRIMARY_STATE_INACTIVE
    assert peer.node.count_subscribers("/correspondences") == 0
    assert change_state(peer, Transition.TRANSITION_ACTIVATE)
    talk.connect()
    talk.localize(info, cloud)
    assert change_state(peer, Transition.TRANSITION_DEACTIVATE)
    assert peer.spin_until(lambda: peer.node.count_subscribers("/correspondences") == 0)
    assert not talk.send(info, cloud, 0.3)
    assert change_state(peer, Transition.TRANSITION_CLEANUP)
    assert peer.spin_until(lambda: peer.node.count_publishers("/rs_localizer/pose") == 0)
    # Once more from the start.
    assert change_state(peer, Transition.TRANSITION_CONFIGURE)
    assert change_state(peer, Transition.TRANSITION_ACTIVATE)
    talk.connect()
    talk.localize(info, cloud)
    assert change_state(peer, Transition.TRANSITION_ACTIVE_SHUTDOWN)
    assert state(peer) == State.PRIMARY_STATE_FINALIZED
    assert node.stop() == 0
    assert "Traceback" not in node.log


def test_what_is_fixed_can_be_set_while_it_is_unconfigured(start_node, peer, tmp_path):
    node = start_node("-p", "autostart:=false")

    def set_one(name: str, value: str) -> Any:
        wanted = Parameter(name, value=value).to_parameter_msg()
        request = SetParameters.Request(parameters=[wanted])
        return peer.call(SetParameters, "/rs_localizer/set_parameters", request).results[0]

    assert set_one("map_file", str(tmp_path / "no.npz")).successful
    assert not change_state(peer, Transition.TRANSITION_CONFIGURE)
    node.wait_for_log("not configured: map_file: ")
    for name, value in (("map_file", ""), ("map_frame", "hall"), ("odom_frame", "wheels")):
        assert set_one(name, value).successful
    assert change_state(peer, Transition.TRANSITION_CONFIGURE)
    refused = set_one("map_frame", "cellar")
    assert not refused.successful
    assert refused.reason == (
        "map_frame cannot be changed while the node is inactive: clean it up first"
    )
    assert set_one("map_frame", "hall").successful  # as it is
    assert change_state(peer, Transition.TRANSITION_CLEANUP)
    assert set_one("map_frame", "cellar").successful
    assert node.stop() == 0


def test_a_failing_callback_does_not_end_the_node(recording, start_node, peer):
    # A bug, for once: the first frame raises.
    broken = (
        "import sys; from rs_localizer.pipeline.frames import FrameLocalizer as F\n"
        "localize = F.localize\n"
        "def fail(self, message): F.localize = localize; raise TypeError('a bug')\n"
        "F.localize = fail\n"
        "from rs_localizer.ros.main import main; sys.exit(main())"
    )
    node = start_node(*SHUTTER, run=broken)
    talk = Talk(peer)
    talk.connect()
    info, cloud = inputs(recording)[0]
    assert not talk.send(info, cloud)
    node.wait_for_log("internal_error: TypeError('a bug') in fail")
    talk.localize(info, cloud)
    assert node.stop() == 0


def test_names_can_be_remapped_and_qos_overridden(recording, start_node, peer):
    override = "qos_overrides./cam/camera_info.subscription.reliability"
    start_node("-r", "__ns:=/cam", "-p", f"{override}:=best_effort", *SHUTTER)
    talk = Talk(peer, "/cam", "/cam/rs_localizer")
    talk.connect()
    talk.localize(*inputs(recording)[0])

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


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_a_frame_takes_long(recording, start_node, peer, number):
    slow = (
        "import sys, time; from rs_localizer.pipeline.frames import FrameLocalizer as F\n"
        "def wait(self, message): print('a slow frame', flush=True); time.sleep(100)\n"
        "F.localize = wait\n"
        "from rs_localizer.ros.main import main; sys.exit(main())"
    )
    node = start_node(*SHUTTER, run=slow)
    talk = Talk(peer)
    talk.connect()
    while "a slow frame" not in node.log:
        talk.send(*inputs(recording)[0], timeout=0.1)
    start = time.monotonic()
    assert node.stop(number, number) == 0
    assert time.monotonic() - start < 10.0
    assert "Traceback" not in node.log
