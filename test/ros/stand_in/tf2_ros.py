# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Stands in for tf2_ros where there is none: it is not on PyPI.

The interface is that of geometry2 (branch jazzy) as far as the node uses it, the transforms are
those of a recording. tf2_msgs is not on PyPI either: /tf and /tf_static carry single
geometry_msgs/TransformStamped here.
"""

import threading
from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile

from rs_localizer.io.transforms import TransformError, TransformTree, make_transform
from rs_localizer.ros.node.conversion import make_message


class TransformException(Exception):
    pass


class ExtrapolationException(TransformException):
    pass


_LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)


class Buffer:
    def __init__(self, cache_time: Any = None, node: Any = None) -> None:
        self._lock = threading.Lock()
        self._static: list[TransformStamped] = []
        self._tree = TransformTree()

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        with self._lock:
            self._tree.add(_message(transform), static=False)

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        with self._lock:
            self._static.append(transform)
            self._tree.add(_message(transform), static=True)

    def clear(self) -> None:
        with self._lock:
            self._tree = TransformTree()
            self._tree.add(SimpleNamespace(transforms=self._static), static=True)

    def lookup_transform(
        self, target_frame: str, source_frame: str, time: Any, timeout: Any = None
    ) -> TransformStamped:
        with self._lock:
            try:
                latest = self._tree._latest(target_frame, source_frame)
                stamp = time.nanoseconds or latest or 0
                found = self._tree.lookup(target_frame, source_frame, stamp)
            except TransformError as error:
                if " is known from " not in str(error):
                    raise TransformException(error) from error
                where = "future" if stamp > (latest or 0) else "past"
                text = f"Lookup would require extrapolation into the {where}: {error}"
                raise ExtrapolationException(text) from error
        return make_transform(make_message, stamp, target_frame, source_frame, found)


class TransformListener:
    def __init__(
        self,
        buffer: Buffer,
        node: Any,
        *,
        spin_thread: bool = False,
        qos: Any = None,
        static_qos: Any = None,
    ) -> None:
        self.buffer = buffer
        self.node = node
        self.tf_sub = node.create_subscription(
            TransformStamped, "/tf", lambda item: self.callback(_message(item)), 100
        )
        self.tf_static_sub = node.create_subscription(
            TransformStamped,
            "/tf_static",
            lambda item: self.static_callback(_message(item)),
            _LATCHED,
        )

    def unregister(self) -> None:
        self.node.destroy_subscription(self.tf_sub)
        self.node.destroy_subscription(self.tf_static_sub)

    def callback(self, data: Any) -> None:
        for transform in data.transforms:
            self.buffer.set_transform(transform, "default_authority")

    def static_callback(self, data: Any) -> None:
        for transform in data.transforms:
            self.buffer.set_transform_static(transform, "default_authority")


def _message(item: TransformStamped) -> SimpleNamespace:
    return SimpleNamespace(transforms=[item])


class TransformBroadcaster:
    def __init__(self, node: Any, qos: Any = None) -> None:
        self.pub_tf = node.create_publisher(TransformStamped, "/tf", 100)

    def sendTransform(self, transform: TransformStamped | Iterable[TransformStamped]) -> None:
        items = [transform] if isinstance(transform, TransformStamped) else transform
        for item in items:
            self.pub_tf.publish(item)


class StaticTransformBroadcaster(TransformBroadcaster):
    def __init__(self, node: Any, qos: Any = None) -> None:
        self.pub_tf = node.create_publisher(TransformStamped, "/tf_static", _LATCHED)
