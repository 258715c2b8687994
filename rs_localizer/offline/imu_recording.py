# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The whole of a recording's IMU at once, for estimators of many images."""

from __future__ import annotations

import math

import numpy as np

from rs_localizer.io.bags import BagReader
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import MessageError
from rs_localizer.io.transforms import Transform, TransformError, TransformTree
from rs_localizer.offline.image_sources import IMAGE_TYPES, INFO_TYPE, SourceError, find_topic
from rs_localizer.offline.recordings import RecordingError
from rs_localizer.offline.replay import TF_TYPE, as_tf2, tf_topics
from rs_localizer.pipeline.inputs import IMU_TYPE
from rs_localizer.trajectory.imu import ImuRecording

_NO_FORCE = (math.nan, math.nan, math.nan)


def read_imu_recording(bag: BagReader, topic: str | None, camera_frame: str) -> ImuRecording:
    """What an IMU measured, and how TF says that it hangs on the camera, if it does.

    Args:
        topic: None: the only one of its type.
        camera_frame: optical frame of the camera.

    Raises:
        SourceError: when the topic is not there, or several could be meant.
        RecordingError: when none of its messages can be used, with the reason.
    """
    topic = find_topic(bag, (IMU_TYPE,), topic, "--imu")
    stamps, rates, forces, frame, fault = [], [], [], "", ""
    for _, _, message in bag.messages([topic]):
        try:
            reading = read_imu(message)
        except MessageError as error:
            fault = f": {error}"
            continue
        frame = reading.frame
        stamps.append(reading.stamp_ns)
        rates.append(reading.angular_velocity)
        forces.append(reading.linear_acceleration or _NO_FORCE)
    if not stamps:
        raise RecordingError(f"{bag.path} has no usable message on {topic}{fault}")
    specific_forces = np.array(forces)
    hung = _camera_from_imu(bag, camera_frame, frame)
    return ImuRecording(
        np.array(stamps, np.int64),
        np.array(rates),
        None if hung is None else hung.rotation,
        specific_forces if np.isfinite(specific_forces).any() else None,
        None if hung is None else hung.translation,
    )


def optical_frame(bag: BagReader, info: str | None = None, image: str | None = None) -> str:
    """Frame of the camera, by its first camera_info, else its first image; empty: not known.

    Args:
        info, image: topics; None: the only one of its type.
    """
    for types, topic in (((INFO_TYPE,), info), (IMAGE_TYPES, image)):
        try:
            found = find_topic(bag, types, topic, "")
        except SourceError:
            continue
        for _, _, message in bag.messages([found]):
            return str(message.header.frame_id)
    return ""


def _camera_from_imu(bag: BagReader, camera: str, imu: str) -> Transform | None:
    """By TF; None where it does not connect them."""
    tree = TransformTree()
    for topic in tf_topics(bag, TF_TYPE):
        for _, _, message in bag.messages((topic,)):
            tree.add(as_tf2(message), static=topic == "/tf_static")
    try:
        return tree.lookup(camera, imu, None)
    except TransformError:
        return None
