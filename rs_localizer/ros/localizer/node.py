# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node ``rs_localizer``: correspondences and camera_info in; pose, twist and inliers out."""

import contextlib
import functools
import math
from collections.abc import Callable, Collection
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.serialization import deserialize_message
from rclpy.timer import Timer
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray  # type: ignore[import-untyped]

from rs_localizer.config import ImuUse, NodeConfig, PublishTf
from rs_localizer.core.reasons import Notice
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import TYPES, Localized, each_message
from rs_localizer.io.topics import CAMERA_MARKER, GIVEN_POSES, INLIERS, INTEGRITY, LIVE
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.given_pose import read_given_pose
from rs_localizer.pipeline.inputs import Input, Results, Role, inputs_of
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.localizer import tf
from rs_localizer.ros.localizer.health import (
    Condition,
    diagnose,
    imu_oddity,
    imu_values,
    of_interest,
    readout_values,
    tell,
)
from rs_localizer.ros.localizer.tf import Broadcaster
from rs_localizer.ros.node.conversion import (
    create_output,
    installed,
    make_message,
    message_class,
    steady_timer,
)
from rs_localizer.ros.node.diagnostics import Health
from rs_localizer.ros.node.managed import ManagedNode
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import WINDOW
from rs_localizer.ros.node.subscriptions import FAST_DATA, LATCHED, SENSOR_DATA, Topic
from rs_localizer.ros.node.views import MapView, camera_marker
from rs_localizer.ros.node.worker import Need, Worker
from rs_localizer.settings import NODE_NAME


class Feed:
    """Reads messages where they come, so that a bad one never takes the place of a good one.

    Args:
        worker: gets frames and updates.
        frames: that of the worker, here only to be read.
        refusals: told of messages that cannot be used.
        say: takes a line for the log.
        needs_tf: called once when readings come whose axes are not the camera's.
    """

    def __init__(
        self,
        worker: Worker[FrameLocalizer, Localized],
        frames: FrameLocalizer,
        refusals: Refusals,
        say: Callable[[str], Any],
        needs_tf: Callable[[], None] = lambda: None,
    ) -> None:
        self._worker = worker
        self._frames = frames
        self._refusals = refusals
        self._say = say
        self._needs_tf: Callable[[], None] | None = needs_tf

    def topics(self, config: NodeConfig) -> dict[str, Topic]:
        """The inputs of these settings; what changes the state comes before the frames."""
        make = {
            Role.FRAMES: self._frames_topic,
            Role.STATE: self._state_topic,
            Role.SAMPLES: self._samples_topic,
        }
        found = {
            name: make[item.role](item)
            for name, item in inputs_of(config).items()
            if not item.also or installed(*item.types)  # of packages that most do not have
        }
        if not config.of_cameras:
            found |= {
                name: Topic(message_class(kind), self._take_pose)
                for name, kind in GIVEN_POSES.items()
            }
        return found

    def take_config(self, config: NodeConfig) -> None:
        """Use these settings from the next frame on."""
        self._worker.update("settings", lambda frames: self._change(frames, config))

    def reset(self) -> None:
        """Forget the previous frames."""
        self._worker.update("reset", FrameLocalizer.reset)

    # -- in the thread of the inputs ---------------------------------------------------------

    def _frames_topic(self, item: Input) -> Topic:
        """A topic whose messages the worker localizes."""

        def localize(frames: FrameLocalizer, message: Any) -> Results:
            return item.take(frames, message)

        def take(message: Any) -> None:
            need = Need(_lacks_samples, self._frames.config.imu.wait)
            self._worker.process(item.topic, message, localize, need)

        return Topic(installed(*item.types), take, single=True)

    def _take_pose(self, message: Any) -> None:
        """Use a pose that others know."""
        try:
            given = read_given_pose(message)
        except MessageError as error:
            self._refusals.notice(Notice.PRIOR_REFUSED, str(error))
            return
        kind = "filter's pose" if given.lasts else "given pose"
        self._worker.update(kind, lambda frames: frames.give_pose(given))

    def _samples_topic(self, item: Input) -> Topic:
        """A topic whose messages are all used here; frames wait for them."""
        take = functools.partial(self._take_sample, item)
        return Topic(message_class(item.type), take, FAST_DATA, raw=True, single=True)

    def _take_sample(self, item: Input, serialized: bytes) -> None:
        if self._frames.config.imu.use == ImuUse.NONE:
            return
        message = deserialize_message(serialized, message_class(item.type))
        refusal = item.take(self._frames, message)
        if isinstance(refusal, Refusal):
            self._refusals.add(refusal.reason, refusal.detail)
            return
        self._worker.look()
        if self._needs_tf is not None and self._frames.imu.frame != self._frames.camera_frame:
            self._needs_tf()
            self._needs_tf = None

    def _state_topic(self, item: Input) -> Topic:
        """A topic whose messages are read here; the worker uses them."""
        return Topic(
            message_class(item.type),
            functools.partial(self._take, item),
            LATCHED if item.latched else SENSOR_DATA,
            lasting=item.lasting,
        )

    def _take(self, item: Input, message: Any) -> None:
        try:
            content = item.read(message)
        except MessageError as error:
            self._refusals.add(item.refused, str(error))
            return
        self._worker.update(item.topic, lambda frames: self._use(frames, item, content))

    # -- in the worker's thread, between two frames ------------------------------------------

    def _use(self, frames: FrameLocalizer, item: Input, content: Any) -> None:
        before = frames.map
        try:
            item.use(frames, content)
        except MessageError as error:
            self._refusals.add(item.refused, str(error))
        if frames.map is not None and frames.map is not before:
            self._say(described(frames.map))

    def _change(self, frames: FrameLocalizer, config: NodeConfig) -> None:
        if frames.change(config):
            self._say("new settings: the previous frames are forgotten")


def _lacks_samples(frames: FrameLocalizer, message: Any) -> bool:
    return frames.awaits_imu(stamp_ns(message), frames.config.imu.wait)


def described(landmarks: Map) -> str:
    """A map in one line."""
    return f"the map has {len(landmarks)} landmarks in frame {landmarks.frame!r}"


class Outputs:
    """Publishes frames on the topics of :data:`rs_localizer.io.outputs.TYPES`.

    Args:
        node: creates the publishers, which publish while it is active.
    """

    def __init__(self, node: LifecycleNode) -> None:
        self._node = node
        self._publishers = {
            name: create_output(node, message_class(type_name), f"~/{name}")
            for name, type_name in TYPES.items()
        }

    def publish(self, frame: Localized, names: Collection[str] = tuple(TYPES)) -> None:
        """Publish, of these, what somebody listens to; nothing else is built."""
        wanted = [name for name in names if self._publishers[name].get_subscription_count()]
        for name, message in each_message(frame, make_message, wanted):
            self._publishers[name].publish(message)

    def close(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)


# What output_rate publishes.
_MOTION = tuple(name for name in TYPES if name != INLIERS)
# Notices that the diagnostics repeat: frames are localized, and probably not as they should be.
_ODD = (
    "map_is_camera", "coarse_coordinates", "pixels_outside", "camera_changed", "no_images",
    "lens", "clock", "bad_imu", "map_scale", "map_jumped", "two_publishers", "doubtful",
    "would_fit",
)  # fmt: skip


class LocalizerNode(ManagedNode[NodeConfig, FrameLocalizer, Localized]):
    """Localizes; see :class:`rs_localizer.ros.node.managed.ManagedNode`."""

    task = "localizer"
    lack = Notice.NO_POSE

    def __init__(self, **options: Any) -> None:
        self._localizer: FrameLocalizer | None = None  # the worker's: here only to be read
        self._feed: Feed | None = None
        self._ticks: Timer | None = None  # of output_rate
        self._publish_now: Callable[[FrameLocalizer], None] = lambda _: None
        self._undo = contextlib.ExitStack()  # of what :meth:`open` has made
        super().__init__(NODE_NAME, NodeConfig, tell, **options)
        self._broadcaster = Broadcaster(self, self.refusals)
        # Triggered by the inputs' thread: subscriptions are the executor's.
        self._imu_came = self.create_guard_condition(lambda: self._broadcaster.tf.listen("the IMU"))

    def check(self, config: NodeConfig) -> None:
        FrameLocalizer(config)
        tf.check(config)

    def open(self, config: NodeConfig) -> None:
        frames = FrameLocalizer(config, self.refusals.notice, self._broadcaster.tf)
        frames.load_files()
        if frames.map is not None:
            self.get_logger().info(described(frames.map))
        self._undo.callback(self._broadcaster.close)
        self._broadcaster.configure(config)
        outputs = Outputs(self)
        self._undo.callback(outputs.close)
        map_view = MapView(self)
        self._undo.callback(map_view.close)
        camera_view, integrity = (
            create_output(self, message_class(LIVE[name]), f"~/{name}")
            for name in (CAMERA_MARKER, INTEGRITY)
        )
        for publisher in (camera_view, integrity):
            self._undo.callback(self.destroy_lifecycle_publisher, publisher)

        def publish_all(frame: Localized) -> None:
            if frames.config.output_rate == 0.0 or not frames.predicts:
                outputs.publish(frame)
                self._broadcaster.publish(frame, frames.config)
            else:  # the motion is published at its own times
                outputs.publish(frame, [INLIERS])
                if frames.config.publish_tf == PublishTf.MAP_TO_ODOM:
                    self._broadcaster.publish(frame, frames.config)
            map_view.show(frame.map_frame, frames.map_points)
            watched = camera_view.get_subscription_count() > 0
            if watched and (corners := frames.view_corners) is not None:
                camera_view.publish(MarkerArray(markers=[camera_marker(frame, corners)]))
            if math.isfinite(frame.estimate.integrity):
                integrity.publish(Float64(data=frame.estimate.integrity))

        newest_ns = 0

        def publish_now(frames: FrameLocalizer) -> None:
            nonlocal newest_ns
            now_ns = self.get_clock().now().nanoseconds
            if now_ns == newest_ns or self._ticks is None:  # a simulated clock rests
                return
            frame = frames.at(now_ns)
            if not frame:
                return
            newest_ns = now_ns
            outputs.publish(frame, _MOTION)
            if frames.config.publish_tf == PublishTf.MAP_TO_CAMERA:
                self._broadcaster.publish(frame, frames.config)

        self._publish_now = publish_now
        self._localizer = frames
        worker = self.employ(frames, publish_all)
        say, needs_tf = self.get_logger().info, self._imu_came.trigger
        self._feed = Feed(worker, frames, self.refusals, say, needs_tf)
        reset = self.create_service(Trigger, "~/reset", self._reset)
        self._undo.callback(self.destroy_service, reset)

    def close(self) -> None:
        self._feed = self._localizer = None
        self._undo.close()

    def begin(self, config: NodeConfig) -> None:
        assert self._feed is not None
        topics = self.listen(self._feed.topics(config))
        if config.readout_time == 0.0 and not config.of_cameras:
            until = " until it is estimated" if config.estimate_readout_time else ""
            self.warn(
                "readout_time is 0 (unknown): no twist is published and frames are not tracked"
                f"{until}"
            )
        self.get_logger().info(
            f"active with solver {config.solver}, listening to {' and '.join(topics)}"
        )

        self._tick_at(config.output_rate)

    def end(self) -> None:
        self._tick_at(0.0)
        self._broadcaster.forget()

    def _tick_at(self, rate: float) -> None:
        """Have the motion published so many times a second; 0: with the images only."""
        if self._ticks is not None:
            self.destroy_timer(self._ticks)
            self._ticks = None
        if rate > 0.0:
            self._ticks = steady_timer(self, 1.0 / rate, self._tick)

    def _tick(self) -> None:
        if self.worker is not None:
            self.worker.update("output", self._publish_now)

    def change(self, config: NodeConfig) -> None:
        if self._feed is not None:
            self._broadcaster.configure(config)
            self._feed.take_config(config)
            if self.state == "active":
                self._tick_at(config.output_rate)

    def examine(self) -> tuple[Health, str]:
        frames = self._localizer
        missing = () if frames is None else frames.missing
        oddities = self.refusals.recent(_ODD, WINDOW) | self._broadcaster.fault()
        values: dict[str, str] = {}
        if frames is not None:
            watch, rig, imu = frames.readout_watch, frames.rig_watch, frames.imu.state
            oddities |= imu_oddity(imu) | rig.faults
            oddities |= {"readout_time": watch.fault} if watch.fault else {}
            values = readout_values(watch.measured) | rig.values | imu_values(imu)
        inputs = {
            name: item for name, item in self.silence.items() if name in inputs_of(self.config)
        }
        condition = Condition(
            life_cycle=self.state,
            missing=missing,
            silence=of_interest(inputs, missing),
            oddities=oddities,
            holding=self._broadcaster.holding,
            values=values,
        )
        health = diagnose(condition, self.statistics.summary())
        return health, "" if frames is None else frames.camera_frame

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        assert self._feed is not None  # as long as the service is there
        self._feed.reset()
        self._broadcaster.forget()
        response.success, response.message = True, "the previous pose and twist are forgotten"
        return response
