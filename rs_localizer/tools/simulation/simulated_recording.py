# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Simulated frames and their truth as messages of a recording."""

from typing import Any

from numpy.typing import NDArray

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.messages import make_header, make_quaternion, make_vector
from rs_localizer.io.recording import (
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    CORRESPONDENCES_TOPIC,
    KEYPOINTS_TOPIC,
    MAP_FRAME,
    RAW_IMAGE_TOPIC,
    make_camera_info,
    make_correspondences,
    make_image,
)
from rs_localizer.tools.simulation.renderer import FORMAT, RenderedFrame
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame
from rs_localizer.tools.simulation.true_motion import TrueState

TRUE_POSE_TOPIC = "/truth/pose"
TRUE_TWIST_TOPIC = "/truth/twist"


def write_simulated(
    bag: BagWriter,
    camera: Camera,
    frame: SimulatedFrame | RenderedFrame,
    keypoints: NDArray[Any] | None = None,
) -> None:
    """Write what a camera sees, and the truth at first and middle row."""
    for topic, message in view_messages(camera, frame, frame.stamp_ns, keypoints).items():
        bag.write(topic, message, frame.stamp_ns)
    write_truth(bag, frame.stamp_ns, frame.first_row)
    if frame.middle_ns != frame.stamp_ns:
        write_truth(bag, frame.middle_ns, frame.middle_row)


def view_messages(
    camera: Camera, frame: SimulatedFrame | RenderedFrame, stamp_ns: int,
    keypoints: NDArray[Any] | None = None, optical: str = CAMERA_FRAME,
) -> dict[str, Any]:  # fmt: skip
    """Return camera info, and image, keypoints or correspondences, by topic.

    Args:
        stamp_ns: by the camera's own clock.
        keypoints: instead of correspondences.
        optical: frame of the camera.
    """
    if isinstance(frame, RenderedFrame):
        topic, message = RAW_IMAGE_TOPIC, make_image(stamp_ns, FORMAT, frame.data, optical)
    elif keypoints is None:
        topic = CORRESPONDENCES_TOPIC
        message = make_correspondences(stamp_ns, frame.points, frame.pixels, frame.ids)
    else:
        topic, message = KEYPOINTS_TOPIC, make_cloud(make_message, stamp_ns, optical, keypoints)
    return {CAMERA_INFO_TOPIC: make_camera_info(camera, stamp_ns, optical), topic: message}


def write_truth(
    bag: BagWriter,
    stamp_ns: int,
    state: TrueState,
    body: str = CAMERA_FRAME,
    recorded_ns: int | None = None,
) -> None:
    """Write pose and twist of a body in the map, recorded at its time or another."""
    pose = make_message(
        "geometry_msgs/msg/PoseStamped",
        header=make_header(make_message, stamp_ns, MAP_FRAME),
        pose=make_message(
            "geometry_msgs/msg/Pose",
            position=make_vector(make_message, state.positions[0], "Point"),
            orientation=make_quaternion(make_message, state.rotations[0]),
        ),
    )
    twist = make_message(
        "geometry_msgs/msg/TwistStamped",
        header=make_header(make_message, stamp_ns, body),
        twist=make_message(
            "geometry_msgs/msg/Twist",
            linear=make_vector(make_message, state.linear[0]),
            angular=make_vector(make_message, state.angular[0]),
        ),
    )
    recorded_ns = stamp_ns if recorded_ns is None else recorded_ns
    bag.write(TRUE_POSE_TOPIC, pose, recorded_ns)
    bag.write(TRUE_TWIST_TOPIC, twist, recorded_ns)
