# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All correspondences, or the whole IMU, of a recording at once: for estimators of many images."""

from collections import Counter
from dataclasses import dataclass

import numpy as np

from rs_localizer import matching
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import BagReader
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.clouds import Correspondences, read_correspondences, read_keypoints, read_map
from rs_localizer.io.imu import ImuRecording, read_imu
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES, KEYPOINTS, MAP_POINTS
from rs_localizer.matching import Matcher, MatchError
from rs_localizer.offline.replay import Topics, imu_topics
from rs_localizer.pipeline.inputs import IMU_TYPE


@dataclass(frozen=True, slots=True)
class Recorded:
    """Correspondences of a recording with a map."""

    calibration: Calibration
    clouds: tuple[Correspondences, ...]


def read_recording(bag: BagReader, topics: Topics, landmarks: Map | None = None) -> Recorded:
    """Read the correspondences of a recording; keypoints are matched with its or a given map.

    The last usable camera_info gives the camera.

    Raises:
        ValueError: without correspondences or camera_info, or with several cameras.
    """
    matcher = None if landmarks is None else Matcher(landmarks)
    clouds: list[Correspondences] = []
    calibration: Calibration | None = None
    faults: Counter[str] = Counter()
    inputs = {topic: name for name, topic in topics.of.items()}
    for topic, _, message in bag.messages(topics.names):
        name = inputs[topic]
        try:
            if name == CAMERA_INFO:
                read = read_camera_info(message)
                read.camera(0.0, ScanDirection.TOP_TO_BOTTOM)  # refuses what is not calibrated
                if calibration is not None and read != calibration:
                    raise ValueError(
                        f"{bag.path}: camera_info changes within the recording; cut it there"
                    )
                calibration = read
            elif name == MAP_POINTS:
                matcher = Matcher(read_map(message))
            elif name == CORRESPONDENCES:
                clouds.append(read_correspondences(message))
            elif name == KEYPOINTS and matcher is not None:
                keypoints = read_keypoints(message)
                matches = matcher.match(keypoints)
                clouds.append(matching.correspondences(matches, keypoints, matcher.map))
        except (MessageError, MatchError) as error:
            faults.update((str(error),))
    if calibration is None:
        raise ValueError(f"{bag.path} has no usable camera_info")
    if not clouds:
        why = f"; {faults.most_common(1)[0][0]}" if faults else ""
        raise ValueError(f"{bag.path} has no usable correspondences{why}")
    return Recorded(calibration, tuple(clouds))


def read_imu_recording(bag: BagReader, topic: str | None) -> ImuRecording:
    """Read the readings of an IMU.

    Args:
        topic: None: the only one of its type.

    Raises:
        BagError: when the topic is not there, or several could be meant.
        ValueError: when none of its messages can be used, with the reason.
    """
    if topic is None and len(found := imu_topics(bag)) == 1:
        topic = found[0]
    topic = bag.find_topic((IMU_TYPE,), topic, "-r imu:=TOPIC")
    stamps, rates, fault = [], [], ""
    for _, _, message in bag.messages([topic]):
        try:
            reading = read_imu(message)
        except MessageError as error:
            fault = f": {error}"
            continue
        stamps.append(reading.stamp_ns)
        rates.append(reading.angular_velocity)
    if not stamps:
        raise ValueError(f"{bag.path} has no usable message on {topic}{fault}")
    return ImuRecording(np.array(stamps, np.int64), np.array(rates))
