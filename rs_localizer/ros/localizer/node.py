# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The node ``rs_localizer``: correspondences and camera_info in; pose, twist and inliers out.

From message to pose: ``Inputs`` takes a message, ``_take_frame`` passes it to the ``Worker``, which
    keeps the newest one. ``FrameLocalizer`` localizes it, and ``Publisher`` publishes the result.
"""

import contextlib
import functools
import math
from collections.abc import Collection
from typing import Any

from rclpy.timer import Timer
from std_srvs.srv import Trigger
from visualization_msgs.msg import MarkerArray  # type: ignore[import-untyped]

from rs_localizer.config import ImuUse, NodeConfig, PublishTf
from rs_localizer.core.reasons import Notice
from rs_localizer.io import topics
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import TYPES, Localized, messages
from rs_localizer.pipeline.camera_frames import CameraFrames
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.given_pose import read_given_pose
from rs_localizer.pipeline.inputs import Input, Results, Role, frame_localizer, inputs_of
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.ros.localizer import tf
from rs_localizer.ros.localizer.broadcaster import Broadcaster
from rs_localizer.ros.localizer.health import (
    Condition,
    diagnose,
    integrity_message,
    of_interest,
    tell,
)
from rs_localizer.ros.node import conversion
from rs_localizer.ros.node.clock import watch_clock
from rs_localizer.ros.node.diagnostics import Health
from rs_localizer.ros.node.managed import ManagedNode
from rs_localizer.ros.node.statistics import WINDOW
from rs_localizer.ros.node.subscriptions import FAST_DATA, LATCHED, SENSOR_DATA, Topic
from rs_localizer.ros.node.views import MapView, camera_marker
from rs_localizer.settings import NODE_NAME

# Inputs whose QoS has parameters, as that of ~/pose has.
_OVERRIDABLE = (topics.CORRESPONDENCES, topics.KEYPOINTS, topics.IMU)
# Outputs that output_rate publishes.
_MOTION = tuple(name for name in TYPES if name != topics.INLIERS)
# Notices that the diagnostics repeat: frames are localized, and probably not as they should be.
_ODD = (
    "map_is_camera", "coarse_coordinates", "pixels_outside", "camera_changed", "no_images",
    "lens", "extrinsics", "bad_imu", "map_scale", "map_jumped", "two_publishers", "doubtful",
    "would_fit", "second_broadcaster", "stale_landmarks", "bad_camera_info", "bad_map",
)  # fmt: skip


class Publisher:
    """Publishes localized frames: their messages, views and transforms.

    Args:
        node: creates the publishers, which publish while it is active.
        frames: what localizes them.
        broadcaster: sends their transforms.
    """

    def __init__(self, node: Any, frames: FrameLocalizer, broadcaster: Broadcaster) -> None:
        self._node, self._frames, self._broadcaster = node, frames, broadcaster
        self._publishers = {
            name: conversion.create_output(
                node, conversion.message_class(kind), f"~/{name}", overridable=name == topics.POSE
            )
            for name, kind in (TYPES | topics.LIVE).items()
            if name not in (topics.MAP_MARKERS, topics.MAP_TO_ODOM)  # others publish them
        }
        self._map_view = MapView(node)
        self._motion: CameraFrames | None = None  # that of the last frame, for other threads
        self._newest_ns = 0

    def publish(self, frame: Localized) -> None:
        """Publish a frame, in the worker's thread."""
        frames, config = self._frames, self._frames.config
        camera = frames if isinstance(frames, CameraFrames) else None
        ticks = config.output_rate > 0.0 and camera is not None and camera.predicts
        self._motion = camera.snapshot() if camera is not None and ticks else None
        self._send(frame, [topics.INLIERS] if ticks else TYPES)
        if not ticks or config.publish_tf == PublishTf.MAP_TO_ODOM:
            self._broadcaster.publish(frame)
        self._map_view.show(frame.map_frame, frames.map_points)
        if camera is not None and self._wanted(topics.CAMERA_MARKER):
            marker = MarkerArray(markers=[camera_marker(frame, camera.camera)])
            self._publishers[topics.CAMERA_MARKER].publish(marker)
        if math.isfinite(frame.estimate.integrity) and self._wanted(topics.INTEGRITY):
            self._publishers[topics.INTEGRITY].publish(integrity_message(frame))

    def publish_motion(self) -> None:
        """Publish pose and twist of now, in the executor's thread, by the last frames' motion."""
        now_ns, motion = self._node.get_clock().now().nanoseconds, self._motion
        if motion is None or now_ns == self._newest_ns:  # a simulated clock rests
            return
        frame, config = motion.at(now_ns), motion.config
        if not frame:
            return
        self._newest_ns = now_ns
        self._send(frame, _MOTION)
        if config.publish_tf == PublishTf.MAP_TO_CAMERA:
            self._broadcaster.publish(frame)

    def forget(self) -> None:
        """Publish nothing of the frames so far."""
        self._motion = None

    def _wanted(self, name: str) -> bool:
        return bool(self._publishers[name].get_subscription_count())

    def _send(self, frame: Localized, names: Collection[str]) -> None:
        """Publish those of these outputs that have subscribers."""
        wanted = list(filter(self._wanted, names))
        for name, message in messages(frame, conversion.make_message, wanted).items():
            self._publishers[name].publish(message)


class LocalizerNode(ManagedNode[NodeConfig, Localized]):
    """Localizes; see :class:`rs_localizer.ros.node.managed.ManagedNode`."""

    node_name, kind, tell, task = NODE_NAME, NodeConfig, staticmethod(tell), "localizer"
    lack = Notice.NO_POSE

    def __init__(self, **options: Any) -> None:
        self._frames: FrameLocalizer | None = None  # the worker's: here only to be read
        self._publisher: Publisher | None = None
        self._ticks: Timer | None = None  # of output_rate
        self._latest: dict[str, Any] = {}  # what the inputs of the state last said
        self._needs_tf = True  # of readings whose axes are not the camera's
        super().__init__(**options)
        self._broadcaster = Broadcaster(self, self.refusals)
        self._clock_watch = watch_clock(self, self._time_jumped)

    def check(self, config: NodeConfig) -> None:
        tf.check(config)

    def open(self, config: NodeConfig) -> None:
        frames = frame_localizer(config, self.refusals.notice, self._broadcaster.tf)
        frames.load_files()
        self._say_map(frames)
        self.opened.callback(self._broadcaster.close)
        self._broadcaster.configure(config)
        self._frames, self._needs_tf, self._latest = frames, True, {}
        self._publisher = Publisher(self, frames, self._broadcaster)
        self.opened.callback(
            self.destroy_service, self.create_service(Trigger, "~/reset", self._reset)
        )
        self.opened.callback(self._drop)
        named = inputs_of(config)

        def localize(topic: str, message: Any) -> Results:
            return named[topic].take_message(frames, message)

        def patience(message: Any) -> float:
            return frames.patience(stamp_ns(message))

        self.employ(localize, self._publisher.publish, patience)

    def _drop(self) -> None:
        self._frames = self._publisher = None

    def begin(self, config: NodeConfig) -> None:
        self.active.callback(self._forget)
        self.active.callback(self._tick_at, 0.0)
        heard = self.listen(self.topics(config))
        if config.readout_time == 0.0 and not config.of_cameras:
            self.warn(
                "readout_time is 0 (unknown): no twist is published and frames are not tracked"
            )
        self.get_logger().info(
            f"active with solver {config.solver}, listening to {' and '.join(heard)}"
        )
        self._tick_at(config.output_rate)

    def change(self, config: NodeConfig) -> None:
        if self._frames is not None:
            self._broadcaster.configure(config)
            self._update("settings", self._change, config)
            if self.state == "active":
                self._tick_at(config.output_rate)

    def _tick_at(self, rate: float) -> None:
        """Publish the motion at this rate (Hz); 0: with the images only."""
        if self._ticks is not None:
            self.destroy_timer(self._ticks)
        self._ticks = None
        if rate > 0.0 and self._publisher is not None:
            self._ticks = conversion.steady_timer(self, 1.0 / rate, self._publisher.publish_motion)

    def _time_jumped(self, seconds: float) -> None:
        self._broadcaster.jumped(seconds)
        self.statistics.restart()

    def _forget(self) -> None:
        if self._publisher is not None:
            self._publisher.forget()
        self._broadcaster.forget()

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._update("reset", FrameLocalizer.reset)
        self._forget()
        response.success, response.message = True, "the previous pose and twist are forgotten"
        return response

    # -- inputs, in the executor's thread ----------------------------------------------------

    def topics(self, config: NodeConfig) -> dict[str, Topic]:
        """Return the topics that the node subscribes to with these settings."""
        take = {
            Role.FRAMES: self._take_frame,
            Role.SAMPLES: self._take_sample,
            Role.STATE: self._take_state,
        }
        found = {}
        for name, item in inputs_of(config).items():
            qos = FAST_DATA if item.role is Role.SAMPLES else SENSOR_DATA
            kind = conversion.installed(*item.types)
            if kind is not None:  # some are of packages that most do not have
                found[name] = Topic(
                    kind,
                    functools.partial(take[item.role], item),
                    LATCHED if item.latched else qos,
                    lasting=item.lasting,
                    overridable=name.rpartition("/")[2] in _OVERRIDABLE,
                    single=item.role is not Role.STATE,
                )
        for name, type_name in topics.GIVEN_POSES.items():
            # Frames of a rig have no prior.
            if not config.of_cameras or name != topics.PRIOR_ODOMETRY:
                found[name] = Topic(conversion.message_class(type_name), self._take_pose)
        return found

    def _take_frame(self, item: Input, message: Any) -> None:
        """Queue a frame to be localized, unless a newer one comes first."""
        assert self.worker is not None
        self.worker.process(item.topic, message)

    def _take_sample(self, item: Input, message: Any) -> None:
        """Use a reading at once; frames wait for them."""
        assert self._frames is not None
        if self._frames.config.imu.use == ImuUse.NONE:
            return
        refusal = item.take_message(self._frames, message)
        if isinstance(refusal, Refusal):
            self.refusals.add(refusal.reason, refusal.detail)
            return
        if self._needs_tf and self._frames.aid.frame != self._frames.camera_frame:
            self._needs_tf = False
            with contextlib.suppress(ValueError):  # the IMU is not used then, and that is said
                self._broadcaster.tf.listen("the IMU")

    def _take_state(self, item: Input, message: Any) -> None:
        """Read here what the worker uses, so that a bad message does not replace a good one."""
        try:
            content = item.read(message)
        except MessageError as error:
            self.refusals.add(item.refused, str(error))
            return
        if content != self._latest.get(item.topic):  # drivers repeat camera_info with every image
            self._latest[item.topic] = content
            self._update(item.topic, self._use, item, content)

    def _take_pose(self, message: Any) -> None:
        """Use a pose that others know."""
        try:
            given = read_given_pose(message)
        except MessageError as error:
            self.refusals.notice(Notice.PRIOR_REFUSED, str(error))
            return
        if not given.lasts:
            self._broadcaster.give(given)
        if self.config.of_cameras:
            return
        kind = "filter's pose" if given.lasts else "given pose"
        self._update(kind, CameraFrames.give_pose, given)

    def _update(self, kind: str, use: Any, *values: Any) -> None:
        """Queue a change of the localizer for the worker, before the next frame."""
        assert self.worker is not None
        self.worker.update(kind, functools.partial(use, self._frames, *values))

    # -- in the worker's thread --------------------------------------------------------------

    def _use(self, frames: FrameLocalizer, item: Input, content: Any) -> None:
        before = frames.landmarks.map
        try:
            item.use(frames, content)
        except MessageError as error:
            self.refusals.add(item.refused, str(error))
        if frames.landmarks.map is not before:
            self._say_map(frames)

    def _change(self, frames: FrameLocalizer, config: NodeConfig) -> None:
        if frames.change(config):
            if (publisher := self._publisher) is not None:  # what the last settings predict
                publisher.forget()
            self.get_logger().info("new settings: the previous frames are forgotten")

    def _say_map(self, frames: FrameLocalizer) -> None:
        if frames.landmarks.map is not None:
            count, frame = len(frames.landmarks.map), frames.landmarks.map.frame
            self.get_logger().info(f"the map has {count} landmarks in frame {frame!r}")

    # -- what it says of itself --------------------------------------------------------------

    def examine(self) -> tuple[Health, str]:
        frames = self._frames
        missing = () if frames is None else frames.missing
        oddities = self.refusals.recent(_ODD, WINDOW) | self._broadcaster.fault()
        values = self._broadcaster.values
        if frames is not None:
            said, odd = frames.describe()
            values, oddities = values | said, oddities | odd
        pose = self.resolve_topic_name(f"~/{topics.POSE}")
        if (count := self.count_publishers(pose)) > 1:
            text = f"{count} nodes publish {pose}: was this one started twice?"
            oddities = oddities | {Notice.TWO_PUBLISHERS: text}
        inputs = {
            name: item for name, item in self.silence.items() if name in inputs_of(self.config)
        }
        condition = Condition(
            life_cycle=self.state,
            missing=missing,
            silence=of_interest(inputs, missing),
            oddities=oddities,
            correction=self._broadcaster.decision,
            values=values,
        )
        health = diagnose(condition, self.statistics.summary())
        return health, "" if frames is None else frames.camera_frame
