"""The node ``rs_localizer``: correspondences and camera_info in; pose, twist and inliers out.

Three threads: the executor's answers services, changes parameters and the life cycle, and publishes
diagnostics; that of the inputs takes messages (see :mod:`.feed`); the worker's
localizes and publishes.
"""

from __future__ import annotations

import contextlib
import functools
import traceback
from collections.abc import Callable

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.service import Service
from std_srvs.srv import Trigger

from rs_localizer.config import NodeConfig
from rs_localizer.io.maps.landmarks import MapError
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.ros.localizer.broadcaster import Broadcaster
from rs_localizer.ros.localizer.feed import FRAME_TOPICS, Feed, described, warm_up
from rs_localizer.ros.localizer.health import Condition, Health, diagnose, of_interest
from rs_localizer.ros.localizer.imu_health import imu_oddity
from rs_localizer.ros.localizer.outputs import Outputs
from rs_localizer.ros.node import parameters, transforms
from rs_localizer.ros.node.diagnostics import Diagnostics
from rs_localizer.ros.node.errors import describe
from rs_localizer.ros.node.inputs import Inputs
from rs_localizer.ros.node.lifecycle import RobustLifecycleNode
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import WINDOW, Statistics
from rs_localizer.ros.node.worker import Worker
from rs_localizer.settings import NODE_NAME

# Notices that the diagnostics repeat: frames are localized, and probably not as they should be.
_ODD = ("map_is_camera", "coarse_coordinates", "pixels_outside", "camera_changed")


class LocalizerNode(RobustLifecycleNode):
    """A managed node; only while active it takes and publishes messages.

    Raises:
        ValueError: when it is started with parameters that are refused, saying what was found.
    """

    def __init__(self, **kwargs) -> None:
        super().__init__(NODE_NAME, **kwargs)
        config = parameters.declare(self)
        _check(config)
        for text in parameters.unknown_names(self):
            self._warn(f"a parameter is ignored: {text}")
        parameters.on_change(self, check=_check, apply=self._take_config, state=lambda: self.state)
        self.autostart = config.autostart
        self.refusals = Refusals(self._warn)
        self._statistics = Statistics(self.refusals, lambda: self.get_clock().now().nanoseconds)
        # From configuring to cleaning up.
        self._localizer: FrameLocalizer | None = None  # the worker's: here only to be read
        self._worker: Worker | None = None
        self._feed: Feed | None = None
        self._outputs: Outputs | None = None
        self._broadcaster = Broadcaster(self, self.refusals)
        self._reset_service: Service | None = None
        # Triggered by the inputs' thread: subscriptions are the executor's.
        self._imu_came = self.create_guard_condition(lambda: self._broadcaster.tf.listen("the IMU"))
        # From activating to deactivating.
        self._inputs: Inputs | None = None
        self._diagnostics = Diagnostics(self, self._examine, self.refusals.notice)

    # -- life cycle -------------------------------------------------------------------------

    def kernels(self) -> Callable[[], None]:
        frames = FrameLocalizer(parameters.read(self))
        log = self.get_logger()
        log.info("compiling kernels (once on this machine, up to a minute)")

        def compiles() -> None:
            with contextlib.suppress(MapError):  # of which on_configure tells, at once
                frames.load_map()
                log.info(f"kernels are ready after {warm_up(frames):.1f} s")

        return compiles

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            config = parameters.read(self)
            frames = FrameLocalizer(config, self.refusals.notice, self._broadcaster.tf)
            frames.load_map()
            if frames.map is not None:
                self.get_logger().info(described(frames.map))
            frames.warm_up()  # what has been set since they were compiled
            self._broadcaster.configure(config)
            self._outputs = Outputs(
                self, afterwards=lambda frame: self._broadcaster.publish(frame, frames.config)
            )
        except MapError as error:
            self.get_logger().error(f"not configured: {error}")
            return TransitionCallbackReturn.FAILURE
        except Exception:  # rclpy would hide it
            self.get_logger().error(f"not configured:\n{traceback.format_exc()}")
            self._close_outputs()
            return TransitionCallbackReturn.FAILURE
        self._localizer = frames
        self._worker = Worker(
            frames,
            self._outputs.publish,
            self._statistics,
            functools.partial(self.refusals.add, "internal_error"),
        )
        self._feed = Feed(
            self._worker,
            frames,
            self.refusals,
            self.get_logger().info,
            self._imu_came.trigger,
        )
        self._reset_service = self.create_service(Trigger, "~/reset", self._reset)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # Before a frame can come: publishers that are not active yet drop its messages.
        result = super().on_activate(state)
        try:
            self._inputs = Inputs(self, self._feed.topics(), self.refusals)
        except Exception as error:  # rclpy would hide it; QoS overrides that make no QoS
            self.get_logger().error(f"not activated: {describe(error)}")
            super().on_deactivate(state)
            return TransitionCallbackReturn.FAILURE
        config = parameters.read(self)
        if config.readout_time == 0.0:
            until = " until it is estimated" if config.estimate_readout_time else ""
            self._warn(
                "readout_time is 0 (unknown): no twist is published and frames are not tracked"
                f"{until}"
            )
        self.get_logger().info(
            f"active with solver {config.solver}, listening to {' and '.join(self._inputs.topics)}"
        )
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close_inputs()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close_outputs()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close_inputs()
        self._close_outputs()
        return super().on_shutdown(state)

    def destroy_node(self) -> None:
        self._close_inputs()
        self._close_outputs()
        super().destroy_node()

    def _close_inputs(self) -> None:
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None
        if self._worker is not None:
            self._worker.pause()
        self._broadcaster.forget()

    def _close_outputs(self) -> None:
        if self._worker is not None:
            self._worker.close()
            self._worker = self._feed = self._localizer = None
        self._broadcaster.close()
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None
        if self._reset_service is not None:
            self.destroy_service(self._reset_service)
            self._reset_service = None

    # -- callbacks of the executor -----------------------------------------------------------

    def _take_config(self, config: NodeConfig) -> None:
        if self._feed is not None:
            self._broadcaster.configure(config)
            self._feed.take_config(config)

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._feed.reset()
        response.success, response.message = True, "the previous pose and twist are forgotten"
        return response

    def _examine(self) -> tuple[Health, str]:
        """For the diagnostics: how the node is, and its camera."""
        frames = self._localizer
        missing = () if frames is None else frames.missing
        silence = {} if self._inputs is None else self._inputs.silence()
        watch = None if frames is None else frames.readout_watch
        imu = None if frames is None else frames.imu.state
        condition = Condition(
            life_cycle=self.state,
            changing=self._feed is not None and self._feed.changing,
            missing=missing,
            frame_topics=FRAME_TOPICS,
            silence=of_interest(silence, FRAME_TOPICS, missing),
            oddities=self.refusals.recent(_ODD, WINDOW)
            | self._broadcaster.fault()
            | imu_oddity(imu)
            | ({"readout_time": watch.fault} if watch and watch.fault else {}),
            readout=watch.measured if watch else None,
            imu=imu,
        )
        health = diagnose(condition, self._statistics.summary())
        return health, "" if frames is None else frames.camera_frame

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)


def _check(config: NodeConfig) -> None:
    """Raise ``ValueError`` for settings that this machine or the localizer cannot do."""
    FrameLocalizer(config)
    transforms.check(config)
