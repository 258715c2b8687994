"""The publishers of a node that looks at images."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any, Generic, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from rclpy.lifecycle import LifecycleNode
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from sensor_msgs.msg import CompressedImage, PointCloud2
from sensor_msgs.msg import Image as ImageMessage

from rs_localizer.io import topics
from rs_localizer.io.images import Image
from rs_localizer.io.messages import Make, make_header
from rs_localizer.ros.node.conversion import make_message

_QOS = {"depth": 10, "reliability": ReliabilityPolicy.RELIABLE}
_JPEG_QUALITY = 85

Found = TypeVar("Found")
Picture = NDArray[np.uint8]  # (h,w,3) blue, green, red
Show = Callable[[Image, Picture], None]


class ImageOutputs(Generic[Found]):
    """The clouds, ``~/debug_image`` and ``~/debug_image/compressed``.

    Nothing is built that nobody listens to. All methods may be called from any thread.

    Args:
        node: creates the publishers, which publish while it is active.
        topic: of the clouds.
        make_cloud: the sensor_msgs/PointCloud2 of what was found in an image.
    """

    def __init__(
        self, node: LifecycleNode, topic: str, make_cloud: Callable[[Found, Make], Any]
    ) -> None:
        self._node = node
        self._make_cloud = make_cloud
        self._clouds = self._create(PointCloud2, topic)
        self._pictures = self._create(ImageMessage, f"~/{topics.DEBUG_IMAGE}")
        self._jpegs = self._create(CompressedImage, f"~/{topics.COMPRESSED_DEBUG_IMAGE}")
        # Held while publishing: after close() nothing is published any more.
        self._lock = threading.Lock()
        self._closed = False

    @property
    def topics(self) -> tuple[str, str]:
        """Full names of the topic of clouds and of the debug image."""
        return self._clouds.topic_name, self._pictures.topic_name

    def clouds_wanted(self) -> bool:
        return not self._closed and self._clouds.get_subscription_count() > 0

    def pictures_wanted(self) -> bool:
        publishers = (self._pictures, self._jpegs)
        return not self._closed and any(p.get_subscription_count() > 0 for p in publishers)

    def publish(self, found: Found) -> None:
        """The cloud of an image."""
        with self._lock:
            if self.clouds_wanted():
                self._clouds.publish(self._make_cloud(found, make_message))

    def show(self, image: Image, picture: Picture) -> None:
        """The debug picture of an image."""
        header = make_header(make_message, image.stamp_ns, image.frame)
        with self._lock:
            if self._closed:
                return
            if self._pictures.get_subscription_count():
                self._pictures.publish(_raw(header, picture))
            if self._jpegs.get_subscription_count():
                self._jpegs.publish(_compressed(header, picture))

    def close(self) -> None:
        with self._lock:
            self._closed = True
            for publisher in (self._clouds, self._pictures, self._jpegs):
                self._node.destroy_lifecycle_publisher(publisher)

    def _create(self, kind: type, topic: str) -> Any:
        return self._node.create_lifecycle_publisher(
            kind,
            topic,
            QoSProfile(**_QOS),  # a new one each: overrides are written into it
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
        )


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


def _compressed(header: Any, picture: Picture) -> Any:
    _, jpeg = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return make_message(
        "sensor_msgs/msg/CompressedImage",
        header=header,
        format="bgr8; jpeg compressed bgr8",
        data=jpeg.ravel(),
    )
