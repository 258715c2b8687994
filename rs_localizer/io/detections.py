# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Tags that other detectors have found: apriltag_msgs and isaac_ros_apriltag_interfaces.

Both are read by the names of their fields. Conventions, from the sources of AprilRobotics/apriltag
and christianrauch/apriltag_ros, which copies ``apriltag_detection_t.p`` into ``corners``: the
corner of the first pixel is at 0, 0 (here: its centre), and the corners of an upright tag are lower
left, lower right, upper right, upper left (here: clockwise from the upper left).
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.messages import MessageError, stamp_ns

APRILTAG_TYPE = "apriltag_msgs/msg/AprilTagDetectionArray"
ISAAC_TYPE = "isaac_ros_apriltag_interfaces/msg/AprilTagDetectionArray"
DEFINITIONS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "apriltag_msgs/Point centre\napriltag_msgs/Point[4] corners\nfloat64[9] homography"
    ),
    APRILTAG_TYPE: "std_msgs/Header header\napriltag_msgs/AprilTagDetection[] detections",
    "isaac_ros_apriltag_interfaces/msg/AprilTagDetection": (
        "string family\nint32 id\ngeometry_msgs/Point center\ngeometry_msgs/Point[4] corners\n"
        "geometry_msgs/PoseWithCovarianceStamped pose"
    ),
    ISAAC_TYPE: (
        "std_msgs/Header header\nisaac_ros_apriltag_interfaces/AprilTagDetection[] detections"
    ),
}
"""Message types, for recordings of ROS 2 before Iron, which do not describe their types."""

_FIRST_PIXEL = 0.5  # where apriltag has the centre of the first pixel
_MOST = 10_000  # tags of an image


@dataclass(frozen=True, slots=True, eq=False)
class TagDetections:
    """The tags of an image."""

    stamp_ns: int
    names: list[tuple[str, int]]  # (m) family, as apriltag calls it, and id
    corners: Array  # (m,4,2) px, centre of the first one at 0, 0; clockwise from the upper left


def read_detections(message: Any) -> TagDetections:
    """Read an AprilTagDetectionArray of either package.

    Raises:
        MessageError: for anything else, saying what was found.
    """
    items = _field(message, "detections", "the message")
    if len(items) > _MOST:
        raise MessageError(f"{len(items)} detections are no tags of one image")
    corners = np.empty((len(items), 4, 2))
    for row, detection in zip(corners, items, strict=True):
        points: Sequence[Any] = _field(detection, "corners", "a detection")
        if len(points) != 4:
            raise MessageError(f"a detection has {len(points)} corners, not 4")
        row[:] = [[point.x, point.y] for point in points]
    if not np.isfinite(corners).all():
        raise MessageError("corners of a detection are not finite")
    names = []
    for detection in items:
        family, number = (_field(detection, name, "a detection") for name in ("family", "id"))
        names.append((re.sub(r"^(?:tag_?)?(?=\d\dh\d)", "tag", str(family)), int(number)))
    return TagDetections(stamp_ns(message), names, corners[:, ::-1] - _FIRST_PIXEL)


def _field(item: Any, name: str, what: str) -> Any:
    try:
        return getattr(item, name)
    except AttributeError:
        raise MessageError(f"{what} has no field {name}") from None
