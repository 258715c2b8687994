"""The whole of a recording's IMU at once, for estimators of many images."""

from __future__ import annotations

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagReader
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import MessageError
from rs_localizer.io.transforms.rigid import TransformError
from rs_localizer.io.transforms.tree import TransformTree
from rs_localizer.offline.image_sources import find_topic
from rs_localizer.offline.recordings import RecordingError
from rs_localizer.offline.replay import TF_TYPE, as_tf2, tf_topics
from rs_localizer.pipeline.inputs import IMU_TYPE
from rs_localizer.trajectory.imu import ImuRecording


def read_imu_recording(bag: BagReader, topic: str | None, camera_frame: str) -> ImuRecording:
    """The turn rates of an IMU, and how TF says that it hangs on the camera, if it does.

    Args:
        topic: None: the only one of its type.
        camera_frame: optical frame of the camera.

    Raises:
        SourceError: when the topic is not there, or several could be meant.
        RecordingError: when none of its messages can be used, with the reason.
    """
    topic = find_topic(bag, (IMU_TYPE,), topic, "--imu")
    stamps, rates, frame, fault = [], [], "", ""
    for _, _, message in bag.messages([topic]):
        try:
            reading = read_imu(message)
        except MessageError as error:
            fault = f": {error}"
            continue
        frame = reading.frame
        stamps.append(reading.stamp_ns)
        rates.append(reading.angular_velocity)
    if not stamps:
        raise RecordingError(f"{bag.path} has no usable message on {topic}{fault}")
    return ImuRecording(
        np.array(stamps, np.int64), np.array(rates), _camera_from_imu(bag, camera_frame, frame)
    )


def _camera_from_imu(bag: BagReader, camera: str, imu: str) -> Array | None:
    """The rotation (3,3) by TF; None where it does not connect them."""
    tree = TransformTree()
    for topic in tf_topics(bag, TF_TYPE):
        for _, _, message in bag.messages((topic,)):
            tree.add(as_tf2(message), static=topic == "/tf_static")
    try:
        return tree.lookup(camera, imu, None).rotation
    except TransformError:
        return None
