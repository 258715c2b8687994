# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A node that looks at images: images in, a cloud for each of them out.

It listens to images only while somebody listens to it.
"""

from __future__ import annotations

from functools import partial
from typing import Any, ClassVar, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import CompressedImage, PointCloud2
from sensor_msgs.msg import Image as ImageMessage

from rs_localizer.config import DetectorConfig, FeatureConfig, ImageTransport
from rs_localizer.core.reasons import Notice, Reason
from rs_localizer.io import topics
from rs_localizer.io.images import read_image
from rs_localizer.io.messages import Make, make_header
from rs_localizer.io.topics import COMPRESSED_IMAGE, IMAGE
from rs_localizer.pipeline.refusal import Refusal, read_or_refuse
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
from rs_localizer.ros.node.statistics import WINDOW, Summary
from rs_localizer.ros.node.subscriptions import Topic

Result = TypeVar("Result")
Picture = NDArray[np.uint8]  # (h,w,3) blue, green, red


# Types of the topics whose messages are looked at.
_IMAGES = {IMAGE: ImageMessage, COMPRESSED_IMAGE: CompressedImage}
# Interval (s) at which the node checks for subscribers.
_LOOK_PERIOD = 0.2

Settings = TypeVar("Settings", DetectorConfig, FeatureConfig)


class ImageNode(ManagedNode[Settings, Result], Generic[Settings, Result]):
    """Looks at images; see :class:`rs_localizer.ros.node.managed.ManagedNode`.

    A node says by its class what it looks for.
    """

    lack = Notice.NO_IMAGES
    finder: ClassVar[Any]  # makes results of images; knows them in words (``described``)
    make_cloud: ClassVar[staticmethod[[Any, Make], Any]]  # the PointCloud2 of a result
    draw: ClassVar[staticmethod[[Any], Picture]]  # the debug picture of a result
    output: ClassVar[str]  # topic of the clouds
    odd: ClassVar[tuple[Notice, ...]] = (Notice.TWO_PUBLISHERS,)  # that the diagnostics repeat

    def __init__(self, **options: Any) -> None:
        self._finder: Any = None  # from configuring on the worker's
        self._outputs: tuple[Any, ...] = ()  # publishers of clouds and of debug pictures
        self._listening: tuple[str, ...] = ()
        super().__init__(**options)

    def make_finder(self, config: Settings) -> Any:
        """Make the finder that looks at images; it works offline, too.

        Raises:
            ValueError: for settings that cannot be used.
        """
        return self.finder(config)

    # -- as every managed node ---------------------------------------------------------------

    def check(self, config: Settings) -> None:
        self.make_finder(config)

    def open(self, config: Settings) -> None:
        self.use_finder(self.make_finder(config))
        self._outputs = (
            create_output(self, PointCloud2, self.output),
            create_output(self, ImageMessage, f"~/{topics.DEBUG_IMAGE}"),
        )
        self.employ(self._look_at, self._publish)

    def _look_at(self, topic: str, message: Any) -> Result | Refusal:
        """Look for what the node looks for, in the worker's thread."""
        image = read_or_refuse(read_image, message, Reason.BAD_IMAGE)
        found: Result | Refusal
        found = image if isinstance(image, Refusal) else self._finder.detect(image)
        return found

    def use_finder(self, finder: Any) -> None:
        """Look at the next images with this one."""
        self._finder = finder

    def begin(self, config: Settings) -> None:
        self._listening = ()
        self.active.callback(self.destroy_timer, steady_timer(self, _LOOK_PERIOD, self._look))
        self.get_logger().info(
            f"active with {self._finder.described}; subscribed to images while somebody "
            f"subscribes to {' or '.join(each.topic_name for each in self._outputs)}"
        )

    def change(self, config: Settings) -> None:
        if self.worker is not None:
            self.worker.update("settings", lambda: self.use_finder(self.make_finder(config)))

    def _publish(self, result: Any) -> None:
        """Publish of an image what somebody listens to, in the worker's thread."""
        clouds, pictures = self._outputs
        if clouds.get_subscription_count():
            clouds.publish(self.make_cloud(result, make_message))
        if pictures.get_subscription_count():
            header = make_header(make_message, result.image.stamp_ns, result.image.frame)
            picture = self.draw(result)
            height, width, _ = picture.shape
            pictures.publish(make_message(
                "sensor_msgs/msg/Image", header=header, height=height, width=width,
                encoding="bgr8", is_bigendian=0, step=3 * width, data=picture.ravel(),
            ))  # fmt: skip

    def examine(self) -> tuple[Health, str]:
        summary = self.statistics.summary()
        health = out_of_service(self.state) or self._health(summary)
        return health.with_values(counts(summary, "Images", "Images done")), ""

    def _health(self, summary: Summary) -> Health:
        """Return the health of an active node."""
        if not self._listening:
            message = f"no subscription to the {self.output} or the debug image"
            return Health(Level.OK, State.IDLE, message)
        causes: list[str] = [f"{it.topic}: {it.cause}" for it in self.silence.values() if it.cause]
        if causes:
            message = "; ".join([f"{State.WAITING} images", *causes])
            return Health(Level.WARN, State.WAITING, message, subject="images")
        message = hindrance(summary, "images")
        if "refused" in message:
            message += f": {', '.join(sorted(summary.recent_reasons))}"
        if message := message or one_line(self.refusals.recent(self.odd, WINDOW)):
            return Health(Level.WARN, State.DETECTING, message)
        message = "no image has been looked at yet" if summary.last is None else summary.last.text
        return Health(Level.OK, State.DETECTING, message)

    # -- who listens ------------------------------------------------------------------------

    def _look(self) -> None:
        """Listen to what is needed just now."""
        assert self.worker is not None
        heard = any(publisher.get_subscription_count() for publisher in self._outputs)
        wanted = (self._image_topic(),) if heard else ()
        if wanted == self._listening:
            return
        self.listen({
            name: Topic(
                _IMAGES[name], partial(self.worker.process, name), overridable=True, single=True
            )
            for name in wanted
        })  # fmt: skip
        self._listening = wanted

    def _image_topic(self) -> str:
        """Return the topic of the images; if none has a publisher, the one so far."""
        transport = self.config.transport
        if transport != ImageTransport.AUTO:
            return IMAGE if transport == ImageTransport.RAW else COMPRESSED_IMAGE
        for topic in _IMAGES:
            if self.count_publishers(self.resolve_topic_name(topic)):
                return topic
        return self._listening[-1] if self._listening else IMAGE
