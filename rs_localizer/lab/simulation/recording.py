"""What the package records: messages of simulated frames and of detected boards, into a bag."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import make_header
from rs_localizer.lab.rendering.image_sequence import RenderedFrame
from rs_localizer.lab.simulation.frames import SimulatedFrame
from rs_localizer.lab.simulation.true_motion import TrueState
from rs_localizer.settings import NODE_NAME

CAMERA_FRAME = "camera_optical_frame"
MAP_FRAME = "map"
CAMERA_INFO_TOPIC = "/camera_info"
CORRESPONDENCES_TOPIC = "/correspondences"
KEYPOINTS_TOPIC = "/keypoints"
IMAGE_TOPIC = "/image/compressed"
RAW_IMAGE_TOPIC = "/image_raw/compressed"
TRUE_POSE_TOPIC = "/truth/pose"
TRUE_TWIST_TOPIC = "/truth/twist"
# A params file and a map of markers in the directory of a recording.
PARAMETERS = "parameters.yaml"
MARKER_MAP = "marker_map.yaml"
MAP = "map.npz"

# Single precision is what RViz shows and most trackers give: 3e-5 px at the rim of an image.
_ROW = np.dtype([(name, "<f4") for name in ("x", "y", "z", "u", "v")] + [("id", "<u4")])


def write_parameters(directory: Path, readout_time: float, scan_direction: str) -> None:
    """The shutter of a recording as a params file beside its data, for ``replay --params``."""
    config = NodeConfig(readout_time=readout_time, scan_direction=scan_direction)
    (directory / PARAMETERS).write_text(
        f"/**/{NODE_NAME}:\n  ros__parameters:\n"  # in whatever namespace
        f"    readout_time: {config.readout_time!r}\n"
        f"    scan_direction: {config.scan_direction}\n",
        encoding="utf-8",
    )


def write_simulated(
    bag: BagWriter, camera: Camera, frame: SimulatedFrame, keypoints: NDArray[Any] | None = None
) -> None:
    """Camera info, correspondences, and the truth at the first and at the middle row.

    With rows of keypoints (n,) these in the place of correspondences.
    """
    if keypoints is None:
        write_frame(bag, camera, frame.stamp_ns, frame.points, frame.pixels, frame.ids)
    else:
        bag.write(CAMERA_INFO_TOPIC, make_camera_info(camera, frame.stamp_ns), frame.stamp_ns)
        cloud = make_cloud(make_message, frame.stamp_ns, CAMERA_FRAME, keypoints)
        bag.write(KEYPOINTS_TOPIC, cloud, frame.stamp_ns)
    write_truth(bag, frame.stamp_ns, frame.first_row)
    if frame.middle_ns != frame.stamp_ns:
        write_truth(bag, frame.middle_ns, frame.middle_row)


def write_rendered(bag: BagWriter, camera: Camera, frame: RenderedFrame) -> None:
    """Camera info, image, and the truth at the first and at the middle row."""
    bag.write(CAMERA_INFO_TOPIC, make_camera_info(camera, frame.stamp_ns), frame.stamp_ns)
    write_image(bag, RAW_IMAGE_TOPIC, frame.stamp_ns, frame.format, frame.data)
    write_truth(bag, frame.stamp_ns, frame.first_row)
    if frame.middle_ns != frame.stamp_ns:
        write_truth(bag, frame.middle_ns, frame.middle_row)


def write_frame(
    bag: BagWriter,
    camera: Camera,
    stamp_ns: int,
    points: Array,
    pixels: Array,
    ids: NDArray[np.int64],
) -> None:
    """Camera info and correspondences of an image: points (n,3), raw pixels (n,2), ids (n,)."""
    rows = np.empty(len(points), _ROW)
    for column, name in enumerate("xyz"):
        rows[name] = points[:, column]
    rows["u"], rows["v"], rows["id"] = pixels[:, 0], pixels[:, 1], ids
    bag.write(CAMERA_INFO_TOPIC, make_camera_info(camera, stamp_ns), stamp_ns)
    cloud = make_cloud(make_message, stamp_ns, MAP_FRAME, rows)
    bag.write(CORRESPONDENCES_TOPIC, cloud, stamp_ns)


def write_truth(bag: BagWriter, stamp_ns: int, state: TrueState) -> None:
    """Pose of the camera in the map and its twist in camera axes, of a state of one instant."""
    x, y, z = state.positions[0].tolist()
    qx, qy, qz, qw = so3.quaternion(np.ascontiguousarray(state.rotations[0])).tolist()
    pose = make_message(
        "geometry_msgs/msg/PoseStamped",
        header=make_header(make_message, stamp_ns, MAP_FRAME),
        pose=make_message(
            "geometry_msgs/msg/Pose",
            position=make_message("geometry_msgs/msg/Point", x=x, y=y, z=z),
            orientation=make_message("geometry_msgs/msg/Quaternion", x=qx, y=qy, z=qz, w=qw),
        ),
    )
    twist = make_message(
        "geometry_msgs/msg/TwistStamped",
        header=make_header(make_message, stamp_ns, CAMERA_FRAME),
        twist=make_message(
            "geometry_msgs/msg/Twist",
            linear=_vector(state.linear[0]),
            angular=_vector(state.angular[0]),
        ),
    )
    bag.write(TRUE_POSE_TOPIC, pose, stamp_ns)
    bag.write(TRUE_TWIST_TOPIC, twist, stamp_ns)


def write_jpeg(bag: BagWriter, stamp_ns: int, jpeg: bytes) -> None:
    """A JPEG image as sensor_msgs/CompressedImage."""
    write_image(bag, IMAGE_TOPIC, stamp_ns, "jpeg", jpeg)


def write_image(bag: BagWriter, topic: str, stamp_ns: int, encoding: str, data: bytes) -> None:
    """A compressed image (``jpeg`` or ``png``) as sensor_msgs/CompressedImage."""
    message = make_message(
        "sensor_msgs/msg/CompressedImage",
        header=make_header(make_message, stamp_ns, CAMERA_FRAME),
        format=encoding,
        data=np.frombuffer(data, np.uint8),
    )
    bag.write(topic, message, stamp_ns)


def _vector(vector: Array) -> Any:
    x, y, z = vector.tolist()
    return make_message("geometry_msgs/msg/Vector3", x=x, y=y, z=z)


def make_camera_info(camera: Camera, stamp_ns: int, frame: str = CAMERA_FRAME) -> Any:
    """The sensor_msgs/CameraInfo of a camera."""
    roi = camera.roi
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
            x_offset=roi.x_offset if roi else 0,
            y_offset=roi.y_offset if roi else 0,
            height=roi.height if roi else 0,
            width=roi.width if roi else 0,
            do_rectify=False,
        ),
    )
