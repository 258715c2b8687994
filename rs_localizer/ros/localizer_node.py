"""The node ``rs_localizer``: correspondences and camera_info in; pose, twist and inliers out."""

from __future__ import annotations

import time
import traceback
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from sensor_msgs.msg import CameraInfo, PointCloud2
from std_srvs.srv import Trigger

from rs_localizer.config import NodeConfig
from rs_localizer.frames import FrameLocalizer
from rs_localizer.io.messages import MessageError
from rs_localizer.io.outputs import TYPES, messages
from rs_localizer.ros import parameters
from rs_localizer.ros.conversion import make_message, message_class
from rs_localizer.ros.lifecycle import RobustLifecycleNode
from rs_localizer.ros.refusals import Refusals
from rs_localizer.settings import NODE_NAME
from rs_localizer.stopping import StopRequest

# Sensor data: the newest counts, and a late one is worth less than none.
_INPUT_QOS = {"depth": 1, "reliability": ReliabilityPolicy.BEST_EFFORT}
_OUTPUT_QOS = {"depth": 10, "reliability": ReliabilityPolicy.RELIABLE}
# A waiting executor does not see signals: it looks up this often, in s.
_SIGNAL_LATENCY = 0.1


class LocalizerNode(RobustLifecycleNode):
    """A managed node; only while active it takes and publishes messages.

    Args:
        compiling: entered while kernels are compiled.

    Raises:
        ValueError: when it is started with parameters that are refused, saying what was found.
    """

    def __init__(
        self, compiling: Callable[[], AbstractContextManager[None]] = nullcontext, **kwargs
    ) -> None:
        super().__init__(NODE_NAME, **kwargs)
        self._compiling = compiling
        config = parameters.declare(self)
        FrameLocalizer(config)  # refuses what it cannot do
        for text in parameters.unknown_names(self):
            self._warn(f"a parameter is ignored: {text}")
        parameters.on_change(self, check=FrameLocalizer, apply=self._take_config)
        self.autostart = config.autostart
        self.refusals = Refusals(self._warn)
        self._frames: FrameLocalizer | None = None
        self._inputs: list[Subscription] = []
        self._outputs: dict[str, Publisher] = {}
        self._reset_service: Service | None = None

    # -- life cycle -------------------------------------------------------------------------

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            frames = FrameLocalizer(parameters.read(self), self.refusals.notice)
            self.get_logger().info("compiling kernels (once on this machine, up to a minute)")
            self._warm_up(frames)
        except Exception:  # rclpy would hide it
            self.get_logger().error(f"not configured:\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        self._frames = frames
        self._outputs = {
            name: self.create_lifecycle_publisher(
                message_class(type_name),
                f"~/{name}",
                QoSProfile(**_OUTPUT_QOS),  # a new one each: overrides are written into it
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for name, type_name in TYPES.items()
        }
        self._reset_service = self.create_service(Trigger, "~/reset", self._reset)
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        # camera_info first: the executor goes through waiting messages in this order.
        self._inputs = [
            self.create_subscription(
                message_type,
                topic,
                callback,
                QoSProfile(**_INPUT_QOS),
                qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            )
            for message_type, topic, callback in (
                (CameraInfo, "camera_info", self._take_camera_info),
                (PointCloud2, "correspondences", self._take_correspondences),
            )
        ]
        if self._frames.config.readout_time == 0.0:
            self._warn(
                "readout_time is 0 (unknown): no twist is published and frames are not tracked"
            )
        self.get_logger().info(
            f"active with solver {self._frames.config.solver}, listening to "
            + " and ".join(subscription.topic_name for subscription in self._inputs)
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

    def _close_inputs(self) -> None:
        for subscription in self._inputs:
            self.destroy_subscription(subscription)
        self._inputs = []

    def _close_outputs(self) -> None:
        for publisher in self._outputs.values():
            self.destroy_lifecycle_publisher(publisher)
        self._outputs = {}
        if self._reset_service is not None:
            self.destroy_service(self._reset_service)
            self._reset_service = None
        self._frames = None

    # -- callbacks --------------------------------------------------------------------------

    def _take_config(self, config: NodeConfig) -> None:
        if self._frames is not None:
            self._frames.config = config
            self._warm_up(self._frames)

    def _take_camera_info(self, message: CameraInfo) -> None:
        try:
            self._frames.take_camera_info(message)
        except MessageError as error:
            self.refusals.add("bad_camera_info", str(error))

    def _take_correspondences(self, message: PointCloud2) -> None:
        result = self._frames.localize(message)
        if not result:
            self.refusals.add(result.reason, result.detail)
            return
        for name, output in messages(result, make_message).items():
            self._outputs[name].publish(output)

    def _reset(self, request: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        self._frames.reset()
        response.success, response.message = True, "the previous pose and twist are forgotten"
        return response

    def _warm_up(self, frames: FrameLocalizer) -> None:
        started = time.monotonic()
        with self._compiling():
            frames.warm_up()
        seconds = time.monotonic() - started
        self.get_logger().info(f"kernels are ready after {seconds:.1f} s")

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)


def run(stop: StopRequest, args: list[str] | None = None) -> int:
    """Run the node until ``stop`` is requested; the exit code."""
    try:
        # rclpy's own handlers end the context from a thread while the node still uses it.
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
        node = LocalizerNode(compiling=stop.at_once)
    except (ValueError, RuntimeError) as error:
        rclpy.logging.get_logger(NODE_NAME).fatal(" ".join(str(error).split()))
        rclpy.try_shutdown()
        return 1
    try:
        return _run(node, stop)
    except ExternalShutdownException:
        return 0
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


def _run(node: LocalizerNode, stop: StopRequest) -> int:
    if node.autostart:
        for transition in (node.trigger_configure, node.trigger_activate):
            if transition() != TransitionCallbackReturn.SUCCESS:
                return 1
    executor = SingleThreadedExecutor()
    executor.add_node(node)
    while not stop.requested:
        try:
            executor.spin_once(timeout_sec=_SIGNAL_LATENCY)
        except ExternalShutdownException:
            raise
        except Exception as error:  # one callback's: the others go on
            where = traceback.extract_tb(error.__traceback__)[-1]
            node.refusals.add(
                "internal_error", f"{error!r} in {where.name}, {where.filename}:{where.lineno}"
            )
    executor.remove_node(node)
    return 0
