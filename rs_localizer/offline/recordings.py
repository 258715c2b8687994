# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All correspondences of a recording at once, for estimators of many images."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from rs_localizer import matching
from rs_localizer.config import Matching
from rs_localizer.io.bags import BagReader
from rs_localizer.io.camera_info import Calibration, read_camera_info
from rs_localizer.io.clouds import Correspondences, read_correspondences
from rs_localizer.io.keypoints import read_keypoints, read_map
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.messages import MessageError
from rs_localizer.io.topics import CAMERA_INFO, CORRESPONDENCES, KEYPOINTS, MAP_POINTS
from rs_localizer.matching import Matcher, MatchError
from rs_localizer.offline.replay import Topics


class RecordingError(ValueError):
    """A recording without a use; the message says what was found."""


@dataclass(frozen=True, slots=True)
class Recorded:
    """What a recording shows of a map."""

    calibration: Calibration
    clouds: tuple[Correspondences, ...]

    @property
    def map_frame(self) -> str:
        return self.clouds[0].frame


def read_recording(
    bag: BagReader, topics: Topics, settings: Matching, landmarks: Map | None = None
) -> Recorded:
    """The correspondences of a recording, keypoints matched with its map or a given one.

    The camera is that of the last usable camera_info.

    Raises:
        RecordingError: without correspondences or camera_info, or with several cameras.
    """
    matcher = None if landmarks is None else Matcher(landmarks)
    clouds: list[Correspondences] = []
    calibration: Calibration | None = None
    faults: Counter[str] = Counter()
    inputs = topics.inputs
    for topic, _, message in bag.messages(topics.names):
        name = inputs[topic].topic
        try:
            if name == CAMERA_INFO:
                read = read_camera_info(message)
                if calibration is not None and read != calibration:
                    raise RecordingError(
                        f"{bag.path}: camera_info changes within the recording; cut it there"
                    )
                calibration = read
            elif name == MAP_POINTS:
                matcher = Matcher(read_map(message))
            elif name == CORRESPONDENCES:
                clouds.append(read_correspondences(message))
            elif name == KEYPOINTS and matcher is not None:
                keypoints = read_keypoints(message)
                matches = matcher.match(keypoints, settings)
                clouds.append(matching.correspondences(matches, keypoints, matcher.map))
        except (MessageError, MatchError) as error:
            faults.update((str(error),))
    if calibration is None:
        raise RecordingError(f"{bag.path} has no usable camera_info")
    if not clouds:
        why = f"; {faults.most_common(1)[0][0]}" if faults else ""
        raise RecordingError(f"{bag.path} has no usable correspondences{why}")
    return Recorded(calibration, tuple(clouds))
