"""The node ``marker_detector``: images in; correspondences with a marker map out.

It listens to images only while somebody listens to it. Three threads, as in the localizer: the
executor's for services, parameters and the life cycle; that of the inputs; the worker's, which
detects and draws.
"""

from __future__ import annotations

import functools
import traceback
from collections.abc import Callable
from typing import Any

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Odometry
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.timer import Timer
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

from rs_localizer.config import DetectorConfig, ImageTransport
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.messages import MessageError
from rs_localizer.pipeline.images import Detected, FrameDetector
from rs_localizer.ros.detector.debug import DebugPictures
from rs_localizer.ros.detector.health import Condition, Sight, diagnose
from rs_localizer.ros.detector.outputs import DetectorOutputs
from rs_localizer.ros.localizer.health import Health
from rs_localizer.ros.node import parameters
from rs_localizer.ros.node.diagnostics import Diagnostics
from rs_localizer.ros.node.inputs import LATCHED, Inputs, Topic
from rs_localizer.ros.node.lifecycle import RobustLifecycleNode
from rs_localizer.ros.node.refusals import Refusals
from rs_localizer.ros.node.statistics import WINDOW, Statistics
from rs_localizer.ros.node.worker import Worker
from rs_localizer.settings import DETECTOR_NAME, NODE_NAME

RAW, COMPRESSED = "image", "image/compressed"
_IMAGES = {RAW: Image, COMPRESSED: CompressedImage}
# How often the node looks whether somebody listens, in s.
_LOOK_PERIOD = 0.2


class DetectorStatistics(Statistics):
    """Counts images."""

    def answered(self, frame: Any, received: float) -> None:
        found = frame.detections
        sight = Sight(
            markers=sum(int(item.known.sum()) for item in found.markers),
            boards=len(found.boards),
            corners=len(found.ids),
            unknown=len(found.unknown),
        )
        self.note(frame.image.stamp_ns, sight, received)


class _Work:
    """What the worker alone touches."""

    def __init__(self, detector: FrameDetector, config: DetectorConfig, debug: DebugPictures):
        self.detector = detector
        self.config = config
        self.debug = debug


class MarkerDetectorNode(RobustLifecycleNode):
    """A managed node; only while active it takes images and publishes.

    Raises:
        ValueError: when it is started with parameters that are refused, saying what was found.
    """

    def __init__(self, **kwargs) -> None:
        super().__init__(DETECTOR_NAME, **kwargs)
        config = parameters.declare(self, DetectorConfig)
        for text in parameters.unknown_names(self, DetectorConfig):
            self._warn(f"a parameter is ignored: {text}")
        parameters.on_change(self, self._check, self._take_config, DetectorConfig)
        self.autostart = config.autostart
        self.refusals = Refusals(self._warn)
        self._statistics = DetectorStatistics(
            self.refusals, lambda: self.get_clock().now().nanoseconds
        )
        # From configuring to cleaning up.
        self._worker: Worker | None = None
        self._outputs: DetectorOutputs | None = None
        self._work: _Work | None = None
        # From activating to deactivating; inputs only while somebody listens.
        self._timer: Timer | None = None
        self._inputs: Inputs | None = None
        self._listening: tuple[str, ...] = ()
        self._diagnostics = Diagnostics(
            self, self._examine, self.refusals.notice, DETECTOR_NAME, "no_images"
        )

    # -- life cycle -------------------------------------------------------------------------

    def kernels(self) -> Callable[[], None]:
        try:
            return FrameDetector(parameters.read(self, kind=DetectorConfig)).warm_up
        except ValueError:  # of which on_configure tells, at once
            return lambda: None

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            config = parameters.read(self, kind=DetectorConfig)
            detector = FrameDetector(config, self.refusals.notice)
            self._outputs = DetectorOutputs(self)
        except ValueError as error:
            self.get_logger().error(f"not configured: {error}")
            return TransitionCallbackReturn.FAILURE
        except Exception:  # rclpy would hide it
            self.get_logger().error(f"not configured:\n{traceback.format_exc()}")
            return TransitionCallbackReturn.FAILURE
        debug = DebugPictures(self._outputs.show, self.refusals.notice)
        self._work = _Work(detector, config, debug)
        self._worker = Worker(
            self._work,
            self._publish,
            self._statistics,
            functools.partial(self.refusals.add, "internal_error"),
        )
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._timer = self.create_timer(
            _LOOK_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        found = self._work.detector.map
        self.get_logger().info(
            f"active with {len(found.markers)} markers and {len(found.boards)} boards in "
            f"{found.map_frame}; listening to images while somebody listens to "
            f"{' or '.join(self._outputs.topics)}"
        )
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._close()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._stop()
        self._close()
        return super().on_shutdown(state)

    def destroy_node(self) -> None:
        self._stop()
        self._close()
        super().destroy_node()

    def _stop(self) -> None:
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None
        self._listen(())
        if self._worker is not None:
            self._worker.pause()

    def _close(self) -> None:
        if self._worker is not None:
            self._worker.close()
            self._worker = self._work = None
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None

    # -- settings ---------------------------------------------------------------------------

    def _check(self, config: DetectorConfig) -> None:
        # Before it is configured, the map may still be missing.
        if config.marker_map or self._worker is not None:
            FrameDetector(config)

    def _take_config(self, config: DetectorConfig) -> None:
        if self._worker is not None:
            self._worker.update("settings", lambda work: self._change(work, config))

    def _change(self, work: _Work, config: DetectorConfig) -> None:
        work.detector = FrameDetector(config, self.refusals.notice)
        work.config = config

    # -- who listens ------------------------------------------------------------------------

    def _look(self) -> None:
        """Listen to what is needed just now."""
        debug = self._outputs.pictures_wanted()
        if not debug and not self._outputs.clouds_wanted():
            self._listen(())
            return
        others = ("camera_info", f"{NODE_NAME}/pose", f"{NODE_NAME}/odometry") if debug else ()
        self._listen((*others, self._image_topic()))

    def _image_topic(self) -> str:
        """The topic of the images; where none has a publisher, the one so far."""
        transport = self.get_parameter("transport").value
        if transport != ImageTransport.AUTO:
            return RAW if transport == ImageTransport.RAW else COMPRESSED
        for topic in (RAW, COMPRESSED):
            if self.count_publishers(self.resolve_topic_name(topic)):
                return topic
        return self._listening[-1] if self._listening else RAW

    def _listen(self, topics: tuple[str, ...]) -> None:
        if topics == self._listening:
            return
        if self._inputs is not None:
            self._inputs.close()
            self._inputs = None
        if topics:
            known = self._topics()
            self._inputs = Inputs(self, {name: known[name] for name in topics}, self.refusals)
        self._listening = topics

    def _topics(self) -> dict[str, Topic]:
        images = {name: Topic(kind, self._images(name)) for name, kind in _IMAGES.items()}
        return images | {
            "camera_info": Topic(CameraInfo, self._take_camera_info, LATCHED),
            f"{NODE_NAME}/pose": Topic(PoseStamped, self._take_pose),
            f"{NODE_NAME}/odometry": Topic(Odometry, self._take_odometry),
        }

    # -- inputs, in their thread -------------------------------------------------------------

    def _images(self, topic: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            self._worker.localize(topic, message, lambda work, image: work.detector.take(image))

        return take

    def _take_camera_info(self, message: CameraInfo) -> None:
        try:
            calibration = read_camera_info(message)
        except MessageError as error:
            self.refusals.notice("bad_camera_info", str(error))
            return
        self._worker.update("camera_info", lambda work: work.debug.take_camera_info(calibration))

    def _take_pose(self, message: PoseStamped) -> None:
        self._worker.update("pose", lambda work: work.debug.take_pose(message))

    def _take_odometry(self, message: Odometry) -> None:
        self._worker.update("odometry", lambda work: work.debug.take_odometry(message, work.config))

    def _examine(self) -> tuple[Health, str]:
        """For the diagnostics: how the node is."""
        silence = {} if self._inputs is None else self._inputs.silence()
        condition = Condition(
            life_cycle=self.state,
            wanted=bool(self._listening),
            silence={name: silence[name] for name in silence if name in _IMAGES},
            oddities=self.refusals.recent(("wrong_map", "repeated_markers"), WINDOW),
        )
        return diagnose(condition, self._statistics.summary()), ""

    # -- in the worker's thread --------------------------------------------------------------

    def _publish(self, detected: Detected) -> None:
        self._outputs.publish(detected)
        if self._outputs.pictures_wanted():
            self._work.debug.add(detected, self._work.detector.map, self._work.config)

    def _warn(self, text: str) -> None:
        self.get_logger().warning(text)
