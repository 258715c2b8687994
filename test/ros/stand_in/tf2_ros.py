# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Stands in for tf2_ros where there is none: it is not on PyPI.

The interface is that of geometry2 (branch jazzy) as far as the node uses it. tf2_msgs is not on
PyPI either: /tf and /tf_static carry single geometry_msgs/TransformStamped here. A frame keeps its
parent from the newest sample on.
"""

from collections.abc import Iterable
from types import SimpleNamespace
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import DurabilityPolicy, QoSProfile
from scipy.spatial.transform import Rotation, Slerp


class TransformException(Exception):
    pass


class LookupException(TransformException):
    pass


class ConnectivityException(TransformException):
    pass


class ExtrapolationException(TransformException):
    pass


_LATCHED = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_MEMORY = 10_000_000_000


def _nanoseconds(stamp: Any) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def _numbers(item: TransformStamped) -> tuple[list[float], list[float]]:
    t, q = item.transform.translation, item.transform.rotation
    return [t.x, t.y, t.z], [q.x, q.y, q.z, q.w]


class Buffer:
    def __init__(self, cache_time: Any = None, node: Any = None) -> None:
        self._samples: dict[str, dict[int, TransformStamped]] = {}  # by child and ns; 0: static

    def set_transform(self, transform: TransformStamped, authority: str) -> None:
        samples = self._samples.setdefault(transform.child_frame_id, {})
        samples.pop(0, None)
        stamp = _nanoseconds(transform.header.stamp)
        if stamp < max(samples, default=0) - _MEMORY:
            return  # TF_OLD_DATA
        samples[stamp] = transform

    def set_transform_static(self, transform: TransformStamped, authority: str) -> None:
        self._samples[transform.child_frame_id] = {0: transform}

    def clear(self) -> None:
        for samples in self._samples.values():
            for stamp in [stamp for stamp in samples if stamp]:
                del samples[stamp]

    def lookup_transform(
        self, target_frame: str, source_frame: str, time: Any, timeout: Any = None
    ) -> TransformStamped:
        parents = {s[max(s)].header.frame_id for s in self._samples.values() if s}
        for frame in (target_frame, source_frame):
            if frame not in self._samples and frame not in parents:
                raise LookupException(f'"{frame}" passed to lookupTransform does not exist. ')
        ways = [self._up(frame) for frame in (target_frame, source_frame)]
        meeting = next((frame for frame in ways[0] if frame in ways[1]), None)
        if meeting is None:
            raise ConnectivityException(
                f"Could not find a connection between '{target_frame}' and '{source_frame}' "
                "because they are not part of the same tree."
            )
        links = [way[: way.index(meeting)] for way in ways]
        stamp = time.nanoseconds
        if stamp == 0:
            latest = [max(self._samples[frame]) for way in links for frame in way]
            stamp = min((latest_of for latest_of in latest if latest_of), default=0)
        result = TransformStamped(child_frame_id=source_frame)
        result.header.frame_id = target_frame
        result.header.stamp.sec, result.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        if not links[0] and len(links[1]) == 1 and 0 in self._samples[source_frame]:
            result.transform = self._samples[source_frame][0].transform  # to the last bit
            return result
        chains = [np.eye(4), np.eye(4)]
        for i, way in enumerate(links):
            for frame in way:
                chains[i] = self._at(frame, stamp) @ chains[i]
        matrix = np.linalg.inv(chains[0]) @ chains[1]
        t, q = result.transform.translation, result.transform.rotation
        t.x, t.y, t.z = matrix[:3, 3].tolist()
        q.x, q.y, q.z, q.w = Rotation.from_matrix(matrix[:3, :3]).as_quat().tolist()
        return result

    def _up(self, frame: str) -> list[str]:
        way = [frame]
        while samples := self._samples.get(frame):
            frame = samples[max(samples)].header.frame_id
            way.append(frame)
        return way

    def _at(self, frame: str, stamp: int) -> Any:
        samples = self._samples[frame]
        if 0 in samples:
            translation, quaternion = _numbers(samples[0])
            rotation = Rotation.from_quat(quaternion)
        else:
            stamps = sorted(samples)
            if not stamps[0] <= stamp <= stamps[-1]:
                where = "future" if stamp > stamps[-1] else "past"
                raise ExtrapolationException(
                    f"Lookup would require extrapolation into the {where}.  Requested time "
                    f"{stamp * 1e-9:.6f} but the data is of {stamps[0] * 1e-9:.6f} to "
                    f"{stamps[-1] * 1e-9:.6f}"
                )
            if len(stamps) == 1:
                stamps, values = [stamps[0], stamps[0] + 1], [_numbers(samples[stamps[0]])] * 2
            else:
                values = [_numbers(samples[s]) for s in stamps]
            seconds = [(s - stamps[0]) * 1e-9 for s in stamps]
            now = (stamp - stamps[0]) * 1e-9
            translation = [
                np.interp(now, seconds, column) for column in np.transpose([t for t, _ in values])
            ]
            rotation = Slerp(seconds, Rotation.from_quat([q for _, q in values]))(now)
        matrix = np.eye(4)
        matrix[:3, 3], matrix[:3, :3] = translation, rotation.as_matrix()
        return matrix


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
