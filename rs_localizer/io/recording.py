# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of the package: topics, and an image or its correspondences as messages."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, Roi
from rs_localizer.io import topics
from rs_localizer.io.bags import make_message
from rs_localizer.io.clouds import make_cloud, make_rows
from rs_localizer.io.messages import make_header

CAMERA_FRAME = "camera_optical_frame"
MAP_FRAME = "map"
CAMERA_INFO_TOPIC = f"/{topics.CAMERA_INFO}"
CORRESPONDENCES_TOPIC = f"/{topics.CORRESPONDENCES}"
KEYPOINTS_TOPIC = f"/{topics.KEYPOINTS}"
IMAGE_TOPIC = f"/{topics.COMPRESSED_IMAGE}"
RAW_IMAGE_TOPIC = "/image_raw/compressed"
# Settings and maps in the directory of a recording, or a camera of a map that was built.
RESULT, BRIDGED = "result", "bridged.txt"
"""Of a result: its bag, and its list of images without a pose of their own."""
PARAMETERS = "parameters.yaml"
CAMERA = "camera.yaml"
MARKER_MAP = "marker_map.yaml"
MAP = "map.npz"

# Single precision is what RViz shows and most trackers give: 3e-5 px at the rim of an image.
_ROW = [*((name, "<f4") for name in "xyzuv"), ("id", "<u4")]


def make_correspondences(
    stamp_ns: int, points: Array, pixels: Array, ids: NDArray[np.int64]
) -> Any:
    """Make a sensor_msgs/PointCloud2 of points (n,3), raw pixels (n,2) and ids (n,)."""
    rows = make_rows(_ROW, [*points.T, *pixels.T, ids])
    return make_cloud(make_message, stamp_ns, MAP_FRAME, rows)


def make_image(stamp_ns: int, encoding: str, data: bytes, frame: str = CAMERA_FRAME) -> Any:
    """Make the sensor_msgs/CompressedImage of a ``jpeg`` or ``png``."""
    return make_message(
        "sensor_msgs/msg/CompressedImage",
        header=make_header(make_message, stamp_ns, frame),
        format=encoding,
        data=np.frombuffer(data, np.uint8),
    )


def make_camera_info(camera: Camera, stamp_ns: int, frame: str = CAMERA_FRAME) -> Any:
    """Make the sensor_msgs/CameraInfo of a camera."""
    roi = camera.roi or Roi(0, 0, 0, 0)
    return make_message(
        "sensor_msgs/msg/CameraInfo",
        header=make_header(make_message, stamp_ns, frame),
        height=camera.height,
        width=camera.width,
        distortion_model=str(camera.distortion_model),
        d=np.array(camera.D),
        k=camera.K.ravel(),
        r=np.eye(3).ravel(),
        p=np.hstack([camera.K, np.zeros((3, 1))]).ravel(),
        binning_x=camera.binning[0],
        binning_y=camera.binning[1],
        roi=make_message(
            "sensor_msgs/msg/RegionOfInterest",
            x_offset=roi.x_offset,
            y_offset=roi.y_offset,
            height=roi.height,
            width=roi.width,
            do_rectify=False,
        ),
    )
