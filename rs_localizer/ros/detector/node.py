"""The node ``marker_detector``: images in; correspondences with a marker map out.

It listens to images only while somebody listens to it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.clock import Clock, ClockType
from rclpy.timer import Timer

from rs_localizer.config import DetectorConfig, ImageTransport
from rs_localizer.core.reasons import Notice
from rs_localizer.io.topics import COMPRESSED_IMAGE, IMAGE
from rs_localizer.pipeline.images import Detected, FrameDetector
from rs_localizer.ros.detector.debug import DebugPictures
from rs_localizer.ros.detector.feed import FOR_PICTURES, IMAGES, Feed, Work
from rs_localizer.ros.detector.health import Condition, Sight, diagnose
from rs_localizer.ros.detector.outputs import DetectorOutputs
from rs_localizer.ros.node.health import Health
from rs_localizer.ros.node.managed import ManagedNode
from rs_localizer.ros.node.statistics import WINDOW
from rs_localizer.settings import DETECTOR_NAME

# How often the node looks whether somebody listens, in s.
_LOOK_PERIOD = 0.2
# Notices that the diagnostics repeat.
_ODD = ("wrong_map", "repeated_markers")


def tell(detected: Detected) -> tuple[int, Sight]:
    """Stamp of an image (ns), and what the statistics keep of it."""
    found = detected.detections
    sight = Sight(
        markers=sum(int(item.known.sum()) for item in found.markers),
        boards=len(found.boards),
        corners=len(found.ids),
        unknown=len(found.unknown),
    )
    return detected.image.stamp_ns, sight


class MarkerDetectorNode(ManagedNode[DetectorConfig, Work, Detected, Sight]):
    """Looks for markers; see :class:`rs_localizer.ros.node.managed.ManagedNode`."""

    task = DETECTOR_NAME
    lack = Notice.NO_IMAGES
    checked_at_start = False  # the map may come later: on_configure tells

    def __init__(self, **options: Any) -> None:
        self._outputs: DetectorOutputs | None = None
        self._feed: Feed | None = None
        self._timer: Timer | None = None
        self._listening: tuple[str, ...] = ()
        super().__init__(DETECTOR_NAME, DetectorConfig, tell, **options)

    def kernels(self) -> Callable[[], None]:
        try:
            return FrameDetector(self.config).warm_up
        except ValueError:  # of which on_configure tells, at once
            return lambda: None

    def check(self, config: DetectorConfig) -> None:
        # Before it is configured, the map may still be missing.
        if config.marker_map or self.worker is not None:
            FrameDetector(config)

    def open(self, config: DetectorConfig) -> None:
        detector = FrameDetector(config, self.refusals.notice)
        self._outputs = outputs = DetectorOutputs(self)
        work = Work(detector, config, DebugPictures(outputs.show, self.refusals.notice))

        def publish(detected: Detected) -> None:
            outputs.publish(detected)
            if outputs.pictures_wanted():
                work.debug.add(detected, work.detector.map, work.config)

        self._feed = Feed(self.employ(work, publish), self.refusals)
        found = detector.map
        self._map = (
            f"{len(found.markers)} markers and {len(found.boards)} boards in {found.map_frame}"
        )

    def close(self) -> None:
        self._feed = None
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None

    def begin(self, config: DetectorConfig) -> None:
        assert self._outputs is not None
        self._timer = self.create_timer(
            _LOOK_PERIOD, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )
        self.get_logger().info(
            f"active with {self._map}; listening to images while somebody listens to "
            f"{' or '.join(self._outputs.topics)}"
        )

    def end(self) -> None:
        self._listening = ()
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def change(self, config: DetectorConfig) -> None:
        if self.worker is not None:
            self.worker.update("settings", lambda work: self._change(work, config))

    def _change(self, work: Work, config: DetectorConfig) -> None:
        work.detector = FrameDetector(config, self.refusals.notice)
        work.config = config

    def examine(self) -> tuple[Health, str]:
        condition = Condition(
            life_cycle=self.state,
            wanted=bool(self._listening),
            silence={name: item for name, item in self.silence.items() if name in IMAGES},
            oddities=self.refusals.recent(_ODD, WINDOW),
        )
        return diagnose(condition, self.statistics.summary()), ""

    # -- who listens ------------------------------------------------------------------------

    def _look(self) -> None:
        """Listen to what is needed just now."""
        assert self._outputs is not None
        assert self._feed is not None
        wanted: tuple[str, ...] = ()
        if self._outputs.pictures_wanted():
            wanted = (*FOR_PICTURES, self._image_topic())
        elif self._outputs.clouds_wanted():
            wanted = (self._image_topic(),)
        if wanted != self._listening:
            known = self._feed.topics()
            self.listen({name: known[name] for name in wanted})
            self._listening = wanted

    def _image_topic(self) -> str:
        """The topic of the images; where none has a publisher, the one so far."""
        transport = self.config.transport
        if transport != ImageTransport.AUTO:
            return IMAGE if transport == ImageTransport.RAW else COMPRESSED_IMAGE
        for topic in IMAGES:
            if self.count_publishers(self.resolve_topic_name(topic)):
                return topic
        return self._listening[-1] if self._listening else IMAGE
