# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node's transforms over TF, and its diagnosis: what a user reads if there are no poses."""

import contextlib
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped
from rclpy.time import Time

from rs_localizer.config import NodeConfig
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import BodyPose, CameraShare, Localized
from rs_localizer.io.transforms import Transform, TransformError
from rs_localizer.pipeline.given_pose import GivenPose
from rs_localizer.pipeline.map_to_odom import CorrectionState, Decision, Standing
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.localizer.broadcaster import Broadcaster
from rs_localizer.ros.localizer.health import Condition, diagnose, integrity_message, tell
from rs_localizer.ros.localizer.tf import Tf, check
from rs_localizer.ros.node.diagnostics import Level
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import Statistics
from rs_localizer.ros.node.subscriptions import Silence

from ..node.test_worker import waits  # noqa: TID252 - Python has a package "test"
from .robot import tf2_ros

HALF_TURN, NO_TURN = (0.0, 0.0, 1.0, 0.0), (0.0, 0.0, 0.0, 1.0)


@pytest.fixture
def robot(peer) -> Any:
    with tf2_ros() as tf2:
        moving = tf2.TransformBroadcaster(peer.node)
        static: list[Any] = []

        def send(
            parent: str, child: str, x: float, stamp_ns: int = 0, turn: Any = HALF_TURN
        ) -> None:
            item = TransformStamped(child_frame_id=child)
            item.header.frame_id = parent
            item.header.stamp.sec, item.header.stamp.nanosec = divmod(stamp_ns, 10**9)
            item.transform.translation.x = x
            q = item.transform.rotation
            q.x, q.y, q.z, q.w = turn
            if stamp_ns:
                moving.sendTransform(item)
            else:  # tf2_ros of Jazzy sends the first transform of a child for ever
                static.append(tf2.StaticTransformBroadcaster(peer.node))
                static[-1].sendTransform(item)

        buffer = tf2.Buffer()
        listener = tf2.TransformListener(buffer, peer.node)
        yield SimpleNamespace(send=send, buffer=buffer)
        listener.unregister()


@pytest.fixture
def made(peer, robot) -> Iterator[Callable[..., Any]]:
    """Makes the node's TF, in a node and a thread of their own as the executor is."""
    parts: list[Any] = []

    def make(**settings: Any) -> SimpleNamespace:
        notes: list[tuple[str, ...]] = []
        notice = SimpleNamespace(notice=lambda *words: notes.append(words))
        broadcaster = Broadcaster(peer.node, notice)
        parts.append(broadcaster)
        broadcaster.configure(NodeConfig(**settings))
        return SimpleNamespace(
            tf=broadcaster.tf, publish=broadcaster.publish, notes=notes, broadcaster=broadcaster
        )

    yield make
    for part in parts:
        part.close()


def frame(stamp_ns: int, x: float = 0.0) -> Localized:
    pose = BodyPose(np.array([x, 0.0, 0.0]), np.eye(3), np.eye(6))
    return Localized(
        input_stamp_ns=stamp_ns, stamp_ns=stamp_ns, map_frame="map", body_frame="base_link",
        pose=pose, twist=None, inliers=np.zeros(0), dropped=0,
        estimate=SimpleNamespace(integrity=0.0),
    )  # fmt: skip


def awaited(peer: Any, ask: Callable[[], Any]) -> Any:
    found: list[Any] = []

    def there() -> bool:
        with contextlib.suppress(Exception):  # tf2_ros' or its stand-in's
            found.append(ask())
        return bool(found)

    assert peer.spin_until(there), "no transform"
    return found[0]


def known(made: Any, peer: Any, target: str, source: str, stamp_ns: int) -> None:
    awaited(peer, lambda: made.tf.lookup(target, source, stamp_ns))


def odometry(node: Any, robot: Any, peer: Any, *tenths: int) -> None:
    """A robot that goes one metre a second."""
    for tenth in tenths:
        robot.send("odom", "base_link", 0.1 * tenth, tenth * 10**8, NO_TURN)
    known(node, peer, "odom", "base_link", tenths[-1] * 10**8)


def heard(robot: Any, peer: Any, parent: str, child: str, stamp_ns: int = 0) -> Any:
    at = Time(nanoseconds=stamp_ns)
    return awaited(peer, lambda: robot.buffer.lookup_transform(parent, child, at))


@pytest.mark.parametrize("turn", [(0.0,) * 4, (float("nan"),) * 4])
def test_a_transform_without_a_rotation_is_named(made, robot, peer, turn):
    node = made(publish_tf="map_to_odom")
    robot.send("odom", "base_link", 0.0, turn=turn)

    def said() -> str:
        try:
            node.tf.lookup("odom", "base_link", None)
        except TransformError as error:
            return str(error)
        return ""

    assert peer.spin_until(lambda: "'base_link' in 'odom' on TF the quaternion" in said())
    assert "is not a rotation" in said()


def test_the_correction_never_stops(made, robot, peer):
    node = made(publish_tf="map_to_odom", transform_tolerance=0.2, hold=3.0)
    assert not node.notes
    node.publish(frame(5_000_000_000))
    assert node.notes[0][0] == "not_broadcast"
    assert "does not exist" in node.notes.pop()[1]
    odometry(node, robot, peer, *range(50, 61))
    node.publish(frame(5_500_000_000, x=5.5))
    # No frame comes any more, odometry does.
    for tenth in range(61, 80):
        robot.send("odom", "base_link", 0.1 * tenth, tenth * 10**8, NO_TURN)
        base = heard(robot, peer, "map", "base_link", tenth * 10**8 - 5 * 10**7)
        assert base.transform.translation.x == pytest.approx(0.1 * tenth - 0.05)
    known(node, peer, "odom", "base_link", 7_900_000_000)
    peer.spin_until(lambda: node.broadcaster.decision.seconds > 2.35)
    assert str(node.broadcaster.decision).startswith("holding for 2.4 s, ")
    assert node.broadcaster.values["map -> odom"] == "held"
    assert node.broadcaster.values["Smallest jump that is refused"].endswith(" deg")
    # A frame that contradicts it beyond all drift is kept aside, and room is made for it.
    node.publish(frame(7_800_000_000, x=97.8))
    decision = node.broadcaster.decision
    assert decision.map_from_odom.translation[0] == pytest.approx(0.0)
    assert decision.covariance[0, 0] > 80.0**2
    # After hold it ends.
    odometry(node, robot, peer, *range(80, 115))
    peer.spin_until(lambda: False, 0.3)
    with pytest.raises(Exception, match="future"):
        robot.buffer.lookup_transform("map", "base_link", Time(nanoseconds=11_300_000_000))
    assert str(node.broadcaster.decision).startswith("not sent since hold ended, 5.9 s after the ")


def test_without_tf2_ros_only_what_needs_it_is_refused(monkeypatch):
    monkeypatch.setitem(sys.modules, "tf2_ros", None)
    check(NodeConfig())
    check(NodeConfig(transform_tolerance=3.0))
    package = "the Python package tf2_ros.* sudo apt install ros-jazzy-tf2-ros-py"
    with pytest.raises(ValueError, match=f"^base_frame 'base_link' needs {package}$"):
        check(NodeConfig(base_frame="base_link"))
    with pytest.raises(ValueError, match=f"^publish_tf map_to_odom needs {package}$"):
        check(NodeConfig(publish_tf="map_to_odom"))
    tf = Tf(None, print)
    with pytest.raises(ValueError, match=f"^the IMU needs {package}$"):
        tf.listen("the IMU")
    with pytest.raises(TransformError, match=f"^the IMU needs {package}$"):
        tf.lookup("camera", "imu", None)


@pytest.mark.parametrize("other", ["forget", "_tick"])
def test_others_wait_until_what_is_being_sent_is_out(made, peer, robot, monkeypatch, other):
    """Who forgets, as after it nothing of the frames so far is sent; and the timer."""
    node = made(publish_tf="map_to_odom", transform_tolerance=0.2)
    odometry(node, robot, peer, *range(50, 61))
    broadcaster, waited = node.broadcaster._broadcaster, []
    send = broadcaster.sendTransform

    def sending(item: Any) -> None:
        waited.append(waits(getattr(node.broadcaster, other)))
        send(item)

    monkeypatch.setattr(broadcaster, "sendTransform", sending)
    node.publish(frame(5_500_000_000, x=5.5))
    assert waited[:1] == [True]


def click(x: float, stamp: float, frame: str = "map") -> GivenPose:
    """A pose as RViz gives it; the stamp in s."""
    covariance = np.diag([0.25, 0.25, 0.0, 0.0, 0.0, 0.0685])
    place = Transform(np.eye(3), np.array([x, 0.0, 0.0]))
    return GivenPose(round(stamp * 1e9), frame, "", place, covariance)


def test_a_click_begins_it_and_is_carried_by_odometry(made, robot, peer):
    sure: list[Any] = []
    peer.node.create_subscription(PoseWithCovarianceStamped, "~/map_to_odom", sure.append, 100)
    node = made(publish_tf="map_to_odom", base_frame="base_link")
    odometry(node, robot, peer, *range(50, 61))
    node.broadcaster.give(click(12.0, 5.5))
    assert node.notes == [("pose_given", "taken: map -> odom begins with it")]
    base = heard(robot, peer, "map", "base_link", 6 * 10**9)
    assert base.transform.translation.x == pytest.approx(12.5)
    assert node.broadcaster.values["Last given pose"].startswith("taken: map -> odom begins")
    assert peer.spin_until(lambda: sure and stamp_ns(sure[-1]) == 6_200_000_000)  # as of TF
    assert sure[-1].header.frame_id == "map"
    assert sure[-1].pose.pose.position.x == pytest.approx(6.5)
    # The body's half a metre across, and its heading over the way back to odometry's origin.
    across = np.sqrt(sure[-1].pose.covariance[7])
    assert across == pytest.approx(np.hypot(0.5, 5.5 * np.sqrt(0.0685)), rel=0.02)
    node.notes.clear()
    node.broadcaster.give(click(0.0, 6.0, frame="odom"))
    assert node.notes[0][1] == "refused: it is in 'odom', the map is 'map'"
    # RViz without use_sim_time stamps by the wall clock; after transform_tolerance it is taken.
    node.broadcaster.give(click(12.5, 1.7e9))
    odometry(node, robot, peer, 61)
    assert len(node.notes) == 1
    peer.spin_until(lambda: False, 0.25)
    odometry(node, robot, peer, 62)
    assert node.notes[1][1].startswith("taken: map -> odom begins with it; odometry does not know")


def test_what_begins_no_transform_is_answered(made, robot, peer):
    """Points in the frame of odometry, a click without a body, and one without odometry."""
    node = made(publish_tf="map_to_odom", base_frame="base_link", transform_tolerance=0.0)
    node.broadcaster.give(click(0.0, 5.0))
    assert node.notes[-1][0] == "pose_given"
    assert node.notes[-1][1].startswith("refused: ")
    assert node.broadcaster.values["Last given pose"].startswith(node.notes[-1][1])
    node.notes.clear()
    odometry(node, robot, peer, *range(50, 61))
    node.publish(replace(frame(5_500_000_000), map_frame="odom"))
    assert [notice for notice, _ in node.notes] == ["not_broadcast"]
    assert "the points are in 'odom', which is odom_frame" in node.notes[0][1]
    node = made(publish_tf="map_to_odom")
    node.broadcaster.give(click(0.0, 5.0))
    assert node.notes == [("pose_given", "refused: set base_frame, of which it is the pose")]
    made(publish_tf="map_to_camera").broadcaster.give(click(0.0, 5.0))


@pytest.fixture
def sending(made, robot, peer) -> Any:
    """A node that sends map -> odom, whose body is known to a centimetre."""
    node = made(publish_tf="map_to_odom", base_frame="base_link")
    odometry(node, robot, peer, *range(50, 61))
    sure = frame(5_500_000_000, x=5.5)
    sure.pose.covariance[...] *= 1e-4
    node.publish(sure)
    heard(robot, peer, "map", "odom")
    return node


def rivals(node: Any) -> list[str]:
    return [text for notice, text in node.notes if notice == "second_broadcaster"]


def test_another_broadcaster_of_the_same_transform_is_seen(sending, robot, peer):
    robot.send("map", "odom", 4.7, 5_400_000_000, NO_TURN)  # by this node before its restart
    peer.spin_until(lambda: False, 0.5)
    assert rivals(sending) == []
    robot.send("map", "odom", 4.7, 6_300_000_000, NO_TURN)
    assert peer.spin_until(lambda: rivals(sending))
    assert rivals(sending)[0] == "another node broadcasts map -> odom, too"
    sending.broadcaster.jumped(-5.0)  # and after time has gone back
    del sending.notes[:]
    odometry(sending, robot, peer, *range(5, 16))
    sending.publish(frame(10**9, x=1.0))
    robot.send("map", "odom", 99.0, 1_300_000_000, NO_TURN)
    assert peer.spin_until(lambda: rivals(sending))


def test_a_static_one_is_seen_for_ever(sending, robot, peer):
    robot.send("map", "odom", 0.0, turn=NO_TURN)
    assert peer.spin_until(lambda: sending.broadcaster.fault())
    assert "map -> odom" in sending.broadcaster.fault()["second_broadcaster"]


def test_a_static_one_that_was_there_before_the_first_pose_is_seen(made, robot, peer):
    robot.send("map", "odom", 4.7, turn=NO_TURN)
    node = made(publish_tf="map_to_odom", base_frame="base_link")
    awaited(peer, lambda: node.tf.lookup("map", "odom", None))
    odometry(node, robot, peer, *range(50, 61))
    assert not node.broadcaster.fault()
    node.publish(frame(5_500_000_000, x=5.5))
    assert "map -> odom" in node.broadcaster.fault()["second_broadcaster"]
    assert len(rivals(node)) == 1


def test_another_parent_of_what_it_sends_is_a_rival(sending, robot, peer, monkeypatch):
    robot.send("world", "odom", 4.7, 6_300_000_000, NO_TURN)
    assert peer.spin_until(lambda: rivals(sending))
    assert rivals(sending)[0] == "TF frame 'odom' has two parents, 'map' and 'world'"
    odometry(sending, robot, peer, *range(61, 66))
    assert peer.spin_until(lambda: "not_broadcast" in dict(sending.notes))
    said = dict(sending.notes)["not_broadcast"]
    assert "TF frame 'odom' already has parent 'world'" in said
    assert "choose" not in said  # what is chosen already
    # It goes on when the other has ended.
    monkeypatch.setattr("rs_localizer.ros.localizer.rivals._LASTS", 0.0)
    robot.send("world", "odom", 4.7, 6_800_000_000, NO_TURN)
    odometry(sending, robot, peer, *range(67, 73))
    assert peer.spin_until(lambda: sending.broadcaster._sent_ns > 7_200_000_000, 20.0)


def test_a_frame_that_has_two_parents_is_seen(sending, robot, peer):
    for _ in range(3):
        robot.send("base_link", "head", 0.0, 6 * 10**9, NO_TURN)
    robot.send("mast", "head", 0.0, 6 * 10**9, NO_TURN)  # it may have been put elsewhere
    peer.spin_until(lambda: False, 0.3)
    assert rivals(sending) == []
    robot.send("base_link", "head", 0.0, 6 * 10**9, NO_TURN)
    assert peer.spin_until(lambda: rivals(sending))
    assert rivals(sending) == ["TF frame 'head' has two parents, 'mast' and 'base_link'"]
    robot.send("base_link", "camera", 0.0)
    robot.send("mast", "camera", 0.0)
    assert peer.spin_until(lambda: sending.broadcaster.fault())


def test_after_a_jump_of_time_nothing_is_sent_of_before(sending, robot, peer):
    sending.broadcaster.jumped(47.0)
    assert sending.broadcaster.decision is None
    assert sending.notes[-1][0] == "time_jumped"
    with pytest.raises(TransformError):
        sending.tf.lookup("odom", "base_link", 6 * 10**9)
    robot.send("odom", "base_link", 6.0, 53 * 10**9, NO_TURN)
    known(sending, peer, "odom", "base_link", 53 * 10**9)
    peer.spin_until(lambda: False, 0.3)
    with pytest.raises(Exception, match="extrapolation"):
        robot.buffer.lookup_transform("map", "odom", Time(nanoseconds=53 * 10**9))


COMES = Silence("/camera_info", 0.1, heard=True, cause="", mismatch=False)
FRAMES = replace(COMES, topic="/correspondences")
GOOD = Condition("active", (), {"camera_info": COMES, "correspondences": FRAMES})


def a_frame(stamp: float = 0.0, tracked: bool = False, rig: bool = False) -> Any:
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
            self.statistics.answered(a_frame(self.now - latency), self.now - latency)
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
