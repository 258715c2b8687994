"""The node ``rs_localizer``: correspondences and camera_info in; pose, twist and inliers out."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any

from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from std_srvs.srv import Trigger

from rs_localizer.config import NodeConfig, Px4Odometry
from rs_localizer.core.reasons import Notice
from rs_localizer.io.maps.landmarks import MapError
from rs_localizer.io.outputs import TYPES, Localized, each_message
from rs_localizer.pipeline.compiling import is_compiled
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.ros.localizer import px4, transforms
from rs_localizer.ros.localizer.feed import Feed, described, warm_up
from rs_localizer.ros.localizer.health import (
    Answer,
    Condition,
    diagnose,
    imu_oddity,
    of_interest,
    tell,
)
from rs_localizer.ros.localizer.transforms import Broadcaster
from rs_localizer.ros.node.conversion import make_message, message_class
from rs_localizer.ros.node.health import Health
from rs_localizer.ros.node.managed import ManagedNode
from rs_localizer.ros.node.statistics import WINDOW
from rs_localizer.settings import NODE_NAME

_QOS = {"depth": 10, "reliability": ReliabilityPolicy.RELIABLE}


class Outputs:
    """Publishes frames on the topics of :data:`rs_localizer.io.outputs.TYPES`.

    Args:
        node: creates the publishers, which publish while it is active.
        afterwards: called with each frame after its messages (to broadcast transforms).
    """

    def __init__(
        self, node: LifecycleNode, afterwards: Callable[[Localized], None] | None = None
    ) -> None:
        self._node = node
        self._afterwards = afterwards
        self._publishers = {
            name: node.create_lifecycle_publisher(
                message_class(type_name),
                f"~/{name}",
                QoSProfile(**_QOS),  # a new one each: overrides are written into it
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name, type_name in TYPES.items()
        }

    def publish(self, frame: Localized) -> None:
        """Publish what somebody listens to; nothing else is built."""
        wanted = [
            name
            for name, publisher in self._publishers.items()
            if publisher.get_subscription_count()
        ]
        for name, message in each_message(frame, make_message, wanted):
            self._publishers[name].publish(message)
        if self._afterwards is not None:
            self._afterwards(frame)

    def close(self) -> None:
        for publisher in self._publishers.values():
            self._node.destroy_lifecycle_publisher(publisher)
        self._publishers = {}


# Notices that the diagnostics repeat: frames are localized, and probably not as they should be.
_ODD = (
    "map_is_camera", "coarse_coordinates", "pixels_outside", "camera_changed", "lens", "bad_imu",
)  # fmt: skip


class LocalizerNode(ManagedNode[NodeConfig, FrameLocalizer, Localized, Answer]):
    """Localizes; see :class:`rs_localizer.ros.node.managed.ManagedNode`."""

    task = "localizer"
    lack = Notice.NO_POSE
    faults = MapError

    def __init__(self, **options: Any) -> None:
        self._localizer: FrameLocalizer | None = None  # the worker's: here only to be read
        self._feed: Feed | None = None
        self._outputs: Outputs | None = None
        self._px4: px4.Px4Output | None = None
        self._reset_service: Service | None = None
        super().__init__(NODE_NAME, NodeConfig, tell, **options)
        self._broadcaster = Broadcaster(self, self.refusals)
        # Triggered by the inputs' thread: subscriptions are the executor's.
        self._imu_came = self.create_guard_condition(lambda: self._broadcaster.tf.listen("the IMU"))

    def kernels(self) -> Callable[[], None]:
        frames = FrameLocalizer(self.config)
        log = self.get_logger()
        self.compiles = not is_compiled(self.config.solver)
        log.info(
            "compiling kernels (once on this machine, up to a minute)"
            if self.compiles
            else "loading kernels"
        )

        def compiles() -> None:
            with contextlib.suppress(MapError):  # of which on_configure tells, at once
                frames.load_map()
                log.info(f"kernels are ready after {warm_up(frames):.1f} s")

        return compiles

    def check(self, config: NodeConfig) -> None:
        FrameLocalizer(config)
        transforms.check(config)
        px4.check(config)

    def open(self, config: NodeConfig) -> None:
        frames = FrameLocalizer(config, self.refusals.notice, self._broadcaster.tf)
        frames.load_map()
        if frames.map is not None:
            self.get_logger().info(described(frames.map))
        frames.warm_up()  # what has been set since they were compiled
        self._broadcaster.configure(config)
        if config.px4_odometry != Px4Odometry.NONE:
            self._px4 = px4.Px4Output(self, frames)
        self._outputs = Outputs(self, afterwards=lambda frame: self._send_on(frame, frames.config))
        self._localizer = frames
        worker = self.employ(frames, self._outputs.publish)
        say, needs_tf = self.get_logger().info, self._imu_came.trigger
        self._feed = Feed(worker, frames, self.refusals, say, needs_tf)
        self._reset_service = self.create_service(Trigger, "~/reset", self._reset)

    def _send_on(self, frame: Localized, config: NodeConfig) -> None:
        if self._px4 is not None:
            self._px4.publish(frame)
        self._broadcaster.publish(frame, config)

    def close(self) -> None:
        self._feed = self._localizer = None
        self._broadcaster.close()
        if self._px4 is not None:
            self._px4.close()
            self._px4 = None
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None
        if self._reset_service is not None:
            self.destroy_service(self._reset_service)
            self._reset_service = None

    def begin(self, config: NodeConfig) -> None:
        assert self._feed is not None
        topics = self.listen(self._feed.topics())
        if config.readout_time == 0.0:
            until = " until it is estimated" if config.estimate_readout_time else ""
            self.warn(
                "readout_time is 0 (unknown): no twist is published and frames are not tracked"
                f"{until}"
            )
        self.get_logger().info(
            f"active with solver {config.solver}, listening to {' and '.join(topics)}"
        )

    def end(self) -> None:
        self._broadcaster.forget()

    def change(self, config: NodeConfig) -> None:
        if self._feed is not None:
            self._broadcaster.configure(config)
            self._feed.take_config(config)

    def examine(self) -> tuple[Health, str]:
        frames = self._localizer
        missing = () if frames is None else frames.missing
        watch = None if frames is None else frames.readout_watch
        imu = None if frames is None else frames.imu.state
        condition = Condition(
            life_cycle=self.state,
            changing=self._feed is not None and self._feed.changing,
            missing=missing,
            silence=of_interest(self.silence, missing),
            oddities=self.refusals.recent(_ODD, WINDOW)
            | self._broadcaster.fault()
            | imu_oddity(imu)
            | ({"readout_time": watch.fault} if watch and watch.fault else {}),
            readout=watch.measured if watch else None,
            imu=imu,
        )
        health = diagnose(condition, self.statistics.summary())
        return health, "" if frames is None else frames.camera_frame

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        assert self._feed is not None  # as long as the service is there
        self._feed.reset()
        response.success, response.message = True, "the previous pose and twist are forgotten"
        return response
