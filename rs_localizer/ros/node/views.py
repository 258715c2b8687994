# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Views for RViz and Foxglove beside the messages of a frame: the map, and the camera in it."""

import math
from typing import TYPE_CHECKING, Any

import numpy as np
from geometry_msgs.msg import Point
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker, MarkerArray  # type: ignore[import-untyped]

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.messages import make_header, make_quaternion, make_vector
from rs_localizer.io.topics import MAP_MARKERS
from rs_localizer.ros.node.conversion import make_message

if TYPE_CHECKING:  # the detectors need no estimates
    from rs_localizer.io.outputs import Localized

# More points of a map only take time: an eye cannot tell them apart.
_MOST_POINTS = 20_000
_POINT, _LINE = 0.02, 0.01  # m
_DEPTH = 0.3  # m, of the drawn view of the camera


class MapView:
    """Publishes a map on ``~/map_markers``, also for late subscribers.

    Args:
        node: a :class:`.ManagedNode`, which publishes it until it is cleaned up.
    """

    def __init__(self, node: Any) -> None:
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        self._publisher = node.create_publisher(MarkerArray, f"~/{MAP_MARKERS}", latched)
        node.opened.callback(node.destroy_publisher, self._publisher)
        self._shown: Array | None = None

    def show(self, frame: str, points: Array | None) -> None:
        """Show landmarks (n,3) or corners of markers (n,4,3), again only if they have changed."""
        if points is not None and points is not self._shown:
            self._shown = points
            self._publisher.publish(MarkerArray(markers=[map_marker(frame, points)]))


def map_marker(frame: str, points: Array) -> Marker:
    """Return landmarks (n,3) as points, or markers (n,4,3) as outlines."""
    squares = points.ndim == 3
    marker = _marker(frame, 0, Marker.LINE_LIST if squares else Marker.POINTS, (0.4, 0.7, 1.0))
    marker.scale.x = marker.scale.y = _LINE if squares else _POINT
    if squares:
        points = np.stack([points, np.roll(points, -1, axis=1)], axis=2).reshape(-1, 3)
    elif len(points) > _MOST_POINTS:
        points = points[np.linspace(0, len(points) - 1, _MOST_POINTS).astype(int)]
    marker.points = _points(points)
    return marker


def camera_marker(frame: "Localized", camera: Camera) -> Marker:
    """Return the camera's view at the middle row, coloured by the trust in the pose."""
    doubt = frame.estimate.integrity
    color = (0.2, 0.5, 1.0)
    if math.isfinite(doubt):  # green, yellow at one half, red
        color = (min(1.0, 2.0 * doubt), min(1.0, 2.0 - 2.0 * doubt), 0.0)
    marker = _marker(frame.map_frame, frame.stamp_ns, Marker.LINE_LIST, color)
    marker.ns, marker.scale.x = "camera", _LINE
    marker.pose.position = make_vector(make_message, frame.estimate.position, "Point")
    marker.pose.orientation = make_quaternion(make_message, frame.estimate.rotation.T)
    width, height = np.array(camera.size) - 1.0
    corners = np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]])
    far = _DEPTH * camera.bearings(corners)
    sides = np.stack([far, np.roll(far, -1, axis=0)], axis=1)
    rays = np.stack([np.zeros_like(far), far], axis=1)
    marker.points = _points(np.concatenate([sides, rays]).reshape(-1, 3))
    return marker


def _marker(frame: str, stamp_ns: int, kind: int, color: tuple[float, float, float]) -> Marker:
    marker = Marker(ns="map", type=kind, action=Marker.ADD)
    marker.header = make_header(make_message, stamp_ns, frame)
    marker.pose.orientation.w = 1.0
    marker.color = ColorRGBA(r=color[0], g=color[1], b=color[2], a=1.0)
    return marker


def _points(points: Array) -> list[Point]:
    return [Point(x=x, y=y, z=z) for x, y, z in points.tolist()]
