# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A node that looks at images: images in, a cloud for each of them out.

It listens to images only while somebody listens to it.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.timer import Timer
from sensor_msgs.msg import CompressedImage, PointCloud2
from sensor_msgs.msg import Image as ImageMessage

from rs_localizer.config import DetectorConfig, FeatureConfig, ImageTransport
from rs_localizer.core.reasons import Notice
from rs_localizer.io import topics
from rs_localizer.io.images import Image
from rs_localizer.io.messages import Make, make_header
from rs_localizer.io.topics import COMPRESSED_IMAGE, IMAGE
from rs_localizer.ros.node.conversion import create_output, make_message, steady_timer
from rs_localizer.ros.node.diagnostics import (
    Health,
    Level,
    State,
    counts,
    hindrance,
    one_line,
    out_of_service,
)
from rs_localizer.ros.node.managed import ManagedNode
from rs_localizer.ros.node.statistics import WINDOW, Summary, Told
from rs_localizer.ros.node.subscriptions import Silence, Topic
from rs_localizer.ros.node.worker import Worker

Result = TypeVar("Result")
Picture = NDArray[np.uint8]  # (h,w,3) blue, green, red


def judge(summary: Summary, silence: Mapping[str, Silence], oddities: Mapping[str, str]) -> Health:
    """Diagnosis of an active node with listeners: ``waiting for images`` or ``detecting``."""
    causes = [f"{item.topic}: {item.cause}" for item in silence.values() if item.cause]
    if causes or not silence:
        message = "; ".join([f"{State.WAITING} images", *causes])
        return Health(Level.WARN, State.WAITING, message, subject="images")
    message = hindrance(summary, "images")
    if "refused" in message:
        message += f": {', '.join(sorted(summary.recent_reasons))}"
    if message := message or one_line(oddities):
        return Health(Level.WARN, State.DETECTING, message)
    last = summary.last
    message = "no image has been looked at yet" if last is None else last.text
    return Health(Level.OK, State.DETECTING, message)


# Types of the topics whose messages are looked at.
_IMAGES = {IMAGE: ImageMessage, COMPRESSED_IMAGE: CompressedImage}
# How often the node looks whether somebody listens, in s.
_LOOK_PERIOD = 0.2

Settings = TypeVar("Settings", DetectorConfig, FeatureConfig)


@dataclass(slots=True)
class Work:
    """State that the worker alone touches."""

    finder: Any


class ImageNode(ManagedNode[Settings, Work, Result], Generic[Settings, Result]):
    """Looks at images; see :class:`rs_localizer.ros.node.managed.ManagedNode`.

    A node says what it looks for by overriding :meth:`make_finder`, :meth:`make_cloud`,
    :meth:`draw` and :meth:`describe`.
    """

    lack = Notice.NO_IMAGES
    output: ClassVar[str]  # topic of the clouds
    odd: ClassVar[tuple[Notice, ...]] = (Notice.TWO_PUBLISHERS,)  # that the diagnostics repeat

    def __init__(
        self,
        name: str,
        kind: Any,  # class of its settings, which mypy cannot follow to the base class
        tell: Callable[[Result], tuple[int, Told]],
        **options: Any,
    ) -> None:
        self._outputs: ImageOutputs[Result] | None = None
        self._topics: dict[str, Topic] = {}  # all that may be listened to
        self._timer: Timer | None = None
        self._listening: tuple[str, ...] = ()
        super().__init__(name, kind, tell, **options)

    # -- what a node looks for ---------------------------------------------------------------

    def make_finder(self, config: Settings) -> Any:
        """The finder that looks at images, of the class that works offline, too.

        Raises:
            ValueError: for settings that cannot be used.
        """
        raise NotImplementedError

    def make_cloud(self, result: Result, make: Make) -> Any:
        """The sensor_msgs/PointCloud2 of an image."""
        raise NotImplementedError

    def draw(self, result: Result) -> tuple[Image, Picture]:
        """An image and its debug picture, in the worker's thread."""
        raise NotImplementedError

    def describe(self, finder: Any) -> str:
        """Words for the log on what the node looks for."""
        raise NotImplementedError

    # -- as every managed node ---------------------------------------------------------------

    def check(self, config: Settings) -> None:
        self.make_finder(config)

    def open(self, config: Settings) -> None:
        finder = self.make_finder(config)
        self._outputs = outputs = ImageOutputs(self, self.output, self.make_cloud, self.draw)
        self._topics = _image_topics(self.employ(Work(finder), outputs.publish))
        self._description = self.describe(finder)

    def close(self) -> None:
        self._topics = {}
        if self._outputs is not None:
            self._outputs.close()
            self._outputs = None

    def begin(self, config: Settings) -> None:
        assert self._outputs is not None
        self._timer = steady_timer(self, _LOOK_PERIOD, self._look)
        self.get_logger().info(
            f"active with {self._description}; subscribed to images while somebody subscribes to "
            f"{' or '.join(self._outputs.topics)}"
        )

    def end(self) -> None:
        self._listening = ()
        if self._timer is not None:
            self.destroy_timer(self._timer)
            self._timer = None

    def change(self, config: Settings) -> None:
        if self.worker is not None:
            self.worker.update("settings", lambda work: self._change(work, config))

    def _change(self, work: Work, config: Settings) -> None:
        work.finder = self.make_finder(config)

    def examine(self) -> tuple[Health, str]:
        summary = self.statistics.summary()
        judgement = out_of_service(self.state)
        if judgement is None and not self._listening:
            message = f"no subscription to the {self.output} or the debug image"
            judgement = Health(Level.OK, State.IDLE, message)
        if judgement is None:
            judgement = judge(summary, self.silence, self.refusals.recent(self.odd, WINDOW))
        return judgement.with_values(counts(summary, "Images", "Images done")), ""

    # -- who listens ------------------------------------------------------------------------

    def _look(self) -> None:
        """Listen to what is needed just now."""
        assert self._outputs is not None
        wanted = (self._image_topic(),) if self._outputs.wanted else ()
        if wanted != self._listening:
            self.listen({name: self._topics[name] for name in wanted})
            self._listening = wanted

    def _image_topic(self) -> str:
        """The topic of the images; where none has a publisher, the one so far."""
        transport = self.config.transport
        if transport != ImageTransport.AUTO:
            return IMAGE if transport == ImageTransport.RAW else COMPRESSED_IMAGE
        for topic in _IMAGES:
            if self.count_publishers(self.resolve_topic_name(topic)):
                return topic
        return self._listening[-1] if self._listening else IMAGE


def _image_topics(worker: Worker[Work, Result]) -> dict[str, Topic]:
    """Both topics of images, whose messages go to the worker."""

    def images(topic: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            worker.process(topic, message, lambda work, image: work.finder.take(image))

        return take

    return {name: Topic(kind, images(name), single=True) for name, kind in _IMAGES.items()}


class ImageOutputs(Generic[Result]):
    """The clouds, and ``~/debug_image``.

    Nothing is built that nobody listens to. All methods may be called from any thread.

    Args:
        node: creates the publishers, which publish while it is active.
        topic: of the clouds.
        make_cloud: the sensor_msgs/PointCloud2 of what was found in an image.
        draw: the image, and its picture.
    """

    def __init__(
        self,
        node: LifecycleNode,
        topic: str,
        make_cloud: Callable[[Result, Make], Any],
        draw: Callable[[Result], tuple[Image, Picture]],
    ) -> None:
        self._node = node
        self._make_cloud, self._draw = make_cloud, draw
        self._clouds = create_output(node, PointCloud2, topic)
        self._pictures = create_output(node, ImageMessage, f"~/{topics.DEBUG_IMAGE}")
        # Held while publishing: after close() nothing is published any more.
        self._lock = threading.Lock()
        self._closed = False

    @property
    def topics(self) -> tuple[str, str]:
        """Full names of the topic of clouds and of the debug image."""
        return self._clouds.topic_name, self._pictures.topic_name

    @property
    def _publishers(self) -> tuple[Any, ...]:
        return self._clouds, self._pictures

    @property
    def wanted(self) -> bool:
        """True while somebody listens."""
        return not self._closed and any(p.get_subscription_count() for p in self._publishers)

    def publish(self, result: Result) -> None:
        """Publish what is wanted of an image."""
        with self._lock:
            if self._closed:
                return
            clouds, pictures = (p.get_subscription_count() for p in self._publishers)
            if clouds:
                self._clouds.publish(self._make_cloud(result, make_message))
            if pictures:
                image, picture = self._draw(result)
                header = make_header(make_message, image.stamp_ns, image.frame)
                self._pictures.publish(_raw(header, picture))

    def close(self) -> None:
        with self._lock:
            self._closed = True
            for publisher in self._publishers:
                self._node.destroy_lifecycle_publisher(publisher)


def _raw(header: Any, picture: Picture) -> Any:
    height, width, _ = picture.shape
    return make_message(
        "sensor_msgs/msg/Image",
        header=header,
        height=height,
        width=width,
        encoding="bgr8",
        is_bigendian=0,
        step=3 * width,
        data=picture.ravel(),
    )
