# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What tests of commands read: a flight, transforms, an IMU, ROS 1 bags, videos."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from scipy.spatial.transform import Rotation

from rs_localizer.cli.commands import main
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import make_message
from rs_localizer.io.imu import make_reading
from rs_localizer.io.transforms import Transform, make_transform
from rs_localizer.tools.simulation.simulated_frames import (
    FrameSettings,
    SimulatedFrame,
    simulate_frames,
)
from rs_localizer.tools.simulation.true_motion import ConstantVelocity

READOUT_TIME = 0.03
SHUTTER = ["-p", f"readout_time:={READOUT_TIME}"]
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, readout_time=READOUT_TIME)


def flight(points: Any, count: int, settings: FrameSettings, start_ns: int) -> list[SimulatedFrame]:
    """Frames of a camera that turns and moves amid points (n,3)."""
    motion = ConstantVelocity(
        np.array([0.5, -1.0, 1.5]), np.array([0.5, 0.2, -0.3]), 0.4, start_ns=start_ns
    )
    return list(simulate_frames(CAMERA, motion, points, settings))[:count]


def record(*words: object) -> None:
    """Write the recording that a command line of ``simulate`` orders."""
    assert main(["--json", "simulate", *map(str, words)]) == 0


def tf(parent: str, child: str, position: Any, turn: Rotation, stamp_ns: int = 0) -> Any:
    pose = Transform(turn.as_matrix(), np.array(position, float))
    stamped = make_transform(make_message, stamp_ns, parent, child, pose)
    return make_message("tf2_msgs/msg/TFMessage", transforms=[stamped])


def imu(stamp_ns: int, rate: Any = (0.0, 0.0, 0.0)) -> Any:
    return make_reading(stamp_ns, np.array(rate), np.array([0.0, 0.0, 9.81]), "imu")


def write_mp4(path: Path, images: Iterable[Any], rate: float) -> Path:
    writer: Any = None
    for image in images:
        if writer is None:
            size = image.shape[::-1]
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"mp4v"), rate, size)
        writer.write(cv2.cvtColor(image, cv2.COLOR_GRAY2BGR))
    writer.release()
    return path


def write_ros1(path: Path, messages: Iterable[tuple[str, int, Any]]) -> Path:
    """Messages as a ROS 1 bag has them: capitals, sequence numbers, TF as before tf2."""
    store = get_typestore(Stores.ROS1_NOETIC)
    definition = "geometry_msgs/TransformStamped[] transforms"
    store.register(get_types_from_msg(definition, "tf/msg/tfMessage"))

    def old(message: Any) -> Any:
        if isinstance(message, list):
            return [old(item) for item in message]
        if not hasattr(message, "__msgtype__"):
            return message
        kind = message.__msgtype__.replace("tf2_msgs/msg/TFMessage", "tf/msg/tfMessage")
        names = {"d": "D", "k": "K", "r": "R", "p": "P"} if kind.endswith("CameraInfo") else {}
        fields = {
            names.get(name, name): old(getattr(message, name))
            for name in message.__dataclass_fields__
            if name != "__msgtype__" and not name.isupper()
        }
        if kind == "std_msgs/msg/Header":
            fields["seq"] = 0
        return store.types[kind](**fields)

    with Ros1Writer(path) as bag:
        connections: dict[str, Any] = {}
        for topic, stamp_ns, message in messages:
            converted = old(message)
            kind = converted.__msgtype__
            if topic not in connections:
                connections[topic] = bag.add_connection(topic, kind, typestore=store)
            bag.write(connections[topic], stamp_ns, store.serialize_ros1(converted, kind))
    return path
