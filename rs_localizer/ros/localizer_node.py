"""The node ``rs_localizer``: correspondences and camera_info in; pose, twist and inliers out.

Three threads: the executor's answers services, changes parameters and the life cycle, and publishes
diagnostics; that of the inputs takes messages; the worker's localizes and publishes.
"""

from __future__ import annotations

import functools
import time
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, ReliabilityPolicy
from rclpy.service import Service
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_srvs.srv import Trigger

from rs_localizer.config import NodeConfig
from rs_localizer.frames import FrameLocalizer
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.keypoints import read_map
from rs_localizer.io.maps import Map, MapError
from rs_localizer.io.messages import MessageError
from rs_localizer.ros import parameters, transforms
from rs_localizer.ros.broadcaster import Broadcaster
from rs_localizer.ros.diagnostics import Diagnostics
from rs_localizer.ros.health import Condition, Health, diagnose, of_interest
from rs_localizer.ros.inputs import Inputs, Topic
from rs_localizer.ros.lifecycle import RobustLifecycleNode
from rs_localizer.ros.outputs import Outputs
from rs_localizer.ros.refusals import Refusals
from rs_localizer.ros.statistics import Statistics
from rs_localizer.ros.worker import Localize, Worker
from rs_localizer.settings import NODE_NAME

# A change of settings that takes longer (s) has compiled kernels, and says so.
_LONG_CHANGE = 0.5
# Inputs that are localized; the others say with what.
_FRAME_TOPICS = ("correspondences", "keypoints")
# Latched: also of a map that was published before the node started.
_MAP_QOS = {
    "depth": 1,
    "reliability": ReliabilityPolicy.RELIABLE,
    "durability": DurabilityPolicy.TRANSIENT_LOCAL,
}


class LocalizerNode(RobustLifecycleNode):
    """A managed node; only while active it takes and publishes messages.

    Args:
        compiling: entered while configuring compiles kernels.

    Raises:
        ValueError: when it is started with parameters that are refused, saying what was found.
    """

    def __init__(
        self, compiling: Callable[[], AbstractContextManager[None]] = nullcontext, **kwargs
    ) -> None:
        super().__init__(NODE_NAME, **kwargs)
        self._compiling = compiling
        config = parameters.declare(self)
        _check(config)
        for text in parameters.unknown_names(self):
            self._warn(f"a parameter is ignored: {text}")
        parameters.on_change(self, check=_check, apply=self._take_config)
        self.autostart = config.autostart
        self.refusals = Refusals(self._warn)
        self._statistics = Statistics(self.refusals, lambda: self.get_clock().now().nanoseconds)
        self._changing = False
        # From configuring to cleaning up.
        self._localizer: FrameLocalizer | None = None  # the worker's: here only to be read
        self._worker: Worker | None = None
        self._outputs: Outputs | None = None
        self._broadcaster = Broadcaster(self, self.refusals)
        self._reset_service: Service | None = None
        # From activating to deactivating.
        self._inputs: Inputs | None = None
        self._diagnostics = Diagnostics(self, self._examine, self.refusals.notice)

    # -- life cycle -------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            config = parameters.read(self)
            frames = FrameLocalizer(config, self.refusals.notice, self._broadcaster.tf)
            self.get_logger().info("compiling kernels (once on this machine, up to a minute)")
            self._diagnostics.publish()
            with self._compiling():
                frames.load_map()
                self._say_map(frames)
                seconds = _warm_up(frames)
            self.get_logger().info(f"kernels are ready after {seconds:.1f} s")
            self._broadcaster.configure(config)
        except MapError as error:
            self.get_logger().error(f"not configured: {error}")
            return TransitionCallbackReturn.FAILURE
        except Exception:  # rclpy would hide it
            self.get_logger().error(f"not configured:\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        self._outputs = Outputs(
            self, afterwards=lambda frame: self._broadcaster.publish(frame, frames.config)
        )
        self._localizer = frames
        self._worker = Worker(
            frames,
            self._outputs.publish,
            self._statistics,
            functools.partial(self.refusals.add, "internal_error"),
        )
        self._reset_service = self.create_service(Trigger, "~/reset", self._reset)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._inputs = Inputs(self, self._topics(), self.refusals)
        config = parameters.read(self)
        if config.readout_time == 0.0:
            self._warn(
                "readout_time is 0 (unknown): no twist is published and frames are not tracked"
            )
        self.get_logger().info(
            f"active with solver {config.solver}, listening to {' and '.join(self._inputs.topics)}"
        )
        return super().on_activate(state)

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
            self._worker = self._localizer = None
        self._broadcaster.close()
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None
        if self._reset_service is not None:
            self.destroy_service(self._reset_service)
            self._reset_service = None

    # -- inputs, in their thread -------------------------------------------------------------

    def _topics(self) -> dict[str, Topic]:
        """The inputs; what changes the state comes before the frames."""
        return {
            "camera_info": Topic(CameraInfo, self._take_camera_info),
            "map_points": Topic(PointCloud2, self._take_map, _MAP_QOS, lasting=True),
            "correspondences": self._frames(
                "correspondences", lambda frames, message: frames.localize(message)
            ),
            "keypoints": self._frames(
                "keypoints", lambda frames, message: frames.localize_keypoints(message)
            ),
        }

    def _frames(self, topic: str, localize: Localize) -> Topic:
        """A topic whose messages are frames, which the worker localizes in this way."""

        def take(message: PointCloud2) -> None:
            self._worker.localize(topic, message, localize)

        return Topic(PointCloud2, take)

    def _take_camera_info(self, message: CameraInfo) -> None:
        # Read here, not in the worker, where a bad one could take the place of a good one.
        try:
            calibration = read_camera_info(message)
        except MessageError as error:
            self.refusals.add("bad_camera_info", str(error))
            return
        if calibration != self._localizer.calibration:  # drivers repeat it with every image
            self._worker.update("camera_info", lambda frames: self._calibrate(frames, calibration))

    def _take_map(self, message: PointCloud2) -> None:
        # Read here for the same reason; meanwhile frames are localized by the previous one.
        try:
            landmarks = read_map(message)
        except MessageError as error:
            self.refusals.add("bad_map", str(error))
            return
        self._worker.update("map", lambda frames: self._use_map(frames, landmarks))

    def _take_config(self, config: NodeConfig) -> None:
        if self._worker is not None:
            self._broadcaster.configure(config)
            self._worker.update("settings", lambda frames: self._change(frames, config))

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._worker.update("reset", FrameLocalizer.reset)
        response.success, response.message = True, "the previous pose and twist are forgotten"
        return response

    def _examine(self) -> tuple[Health, str]:
        """For the diagnostics: how the node is, and its camera."""
        frames = self._localizer
        missing = () if frames is None else frames.missing
        silence = {} if self._inputs is None else self._inputs.silence()
        condition = Condition(
            life_cycle=self._state_machine.current_state[1],
            changing=self._changing,
            missing=missing,
            frame_topics=_FRAME_TOPICS,
            silence=of_interest(silence, _FRAME_TOPICS, missing),
        )
        health = diagnose(condition, self._statistics.summary())
        return health, "" if frames is None else frames.camera_frame

    # -- in the worker's thread, between two frames ------------------------------------------

    def _calibrate(self, frames: FrameLocalizer, calibration: Calibration) -> None:
        try:
            frames.calibrate(calibration)
        except MessageError as error:
            self.refusals.add("bad_camera_info", str(error))

    def _use_map(self, frames: FrameLocalizer, landmarks: Map) -> None:
        if frames.map is None or not landmarks.equals(frames.map):
            frames.use_map(landmarks)
            self._say_map(frames)

    def _change(self, frames: FrameLocalizer, config: NodeConfig) -> None:
        self._changing = True
        try:
            frames.config = config
            seconds = _warm_up(frames)
        finally:
            self._changing = False
        if seconds > _LONG_CHANGE:
            self.get_logger().info(f"kernels for the new settings are ready after {seconds:.1f} s")

    def _say_map(self, frames: FrameLocalizer) -> None:
        if frames.map is not None:
            self.get_logger().info(
                f"the map has {len(frames.map)} landmarks in frame {frames.map.frame!r}"
            )

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)


def _check(config: NodeConfig) -> None:
    """Raise ``ValueError`` for settings that this machine or the localizer cannot do."""
    FrameLocalizer(config)
    transforms.check(config)


def _warm_up(frames: FrameLocalizer) -> float:
    """Compile all kernels that the settings need; how many seconds it took."""
    started = time.monotonic()
    frames.warm_up()
    return time.monotonic() - started
