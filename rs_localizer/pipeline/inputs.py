# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""THE list of the localizer's inputs: topic, type, role, and who reads and uses its messages.

The node subscribes to it, replay looks for it in recordings, commands and launch file have an
option for each topic, and the diagnostics judge what does not come. A new input is a row and a
reader. Launch files read this list: it imports no kernels.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from enum import Enum, auto
from typing import TYPE_CHECKING, Any, Union

from rs_localizer.core.reasons import Reason
from rs_localizer.io import topics
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import EmptyCloudError, read_map
from rs_localizer.io.detections import APRILTAG_TYPE, ISAAC_TYPE
from rs_localizer.io.imu import read_imu
from rs_localizer.io.messages import MessageError
from rs_localizer.pipeline.refusal import Notify, Refusal, unheard

if TYPE_CHECKING:
    from rs_localizer.config import NodeConfig
    from rs_localizer.io.outputs import Localized
    from rs_localizer.io.transforms import Transforms
    from rs_localizer.pipeline.frames import FrameLocalizer

CLOUD_TYPE = "sensor_msgs/msg/PointCloud2"
CAMERA_INFO_TYPE = "sensor_msgs/msg/CameraInfo"
IMU_TYPE = "sensor_msgs/msg/Imu"
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")


Results = Union["Localized", Refusal, Iterator[Union["Localized", Refusal]], None]
"""None: the message was no frame, or its frame waits for others (``output_lag``).

Of a rig an image may complete no frame, or several; each is worked on when it is asked for.
"""


class Role(Enum):
    """Use of the messages of an input."""

    FRAMES = auto()  # each is localized, unless a newer one comes first
    STATE = auto()  # the latest one says how frames are localized
    SAMPLES = auto()  # each counts, and is used where it comes: ``use`` may run in any thread


@dataclass(frozen=True, slots=True)
class Input:
    """One input.

    ``read`` takes a message and returns what it says, which ``use`` gives to the localizer (frames
    that are read as ``Correspondences``: ``CameraFrames.localize_cloud``). Both raise
    ``MessageError`` for what cannot be used; it is refused for the reason ``refused``.
    """

    topic: str  # relative to the node's namespace; also the name of the input
    types: tuple[str, ...]  # of its messages, with the same names of fields
    about: str  # what they hold
    role: Role
    use: Callable[[Any, Any], Results]
    refused: Reason
    # Most frames are read where they are localized, or never.
    read: Callable[[Any], Any] = lambda message: message
    in_words: str = ""  # what a user is told that is missing
    necessary: bool = False  # without it no frame can be localized
    needs: str = ""  # of frames: the input that has to come first, and that only they use
    latched: bool = False  # who comes late wants the last message, too
    lasting: bool = False  # one message is enough

    @property
    def option(self) -> str:
        """The option of commands that names its topic in a recording."""
        return f"-r {self.topic}:=TOPIC"

    def take_message(self, localizer: FrameLocalizer, message: Any) -> Results:
        """Read and use a message at once; the results of frames that are complete with it."""
        frames = self.role is Role.FRAMES
        try:
            return self.use(localizer, self.read(message))
        except EmptyCloudError as error:
            return Refusal(Reason.EMPTY_CLOUD if frames else self.refused, str(error))
        except MessageError as error:
            return Refusal(self.refused, str(error))


# What changes the state comes before the frames: waiting messages are taken in this order.
# fmt: off
_ROWS = (
    Input(
        topics.CAMERA_INFO, (CAMERA_INFO_TYPE,), "the camera's calibration", Role.STATE,
        lambda localizer, calibration: localizer.calibrate(calibration), Reason.BAD_CAMERA_INFO,
        read=read_camera_info, in_words="camera_info", necessary=True, latched=True,
    ),
    Input(
        topics.MAP_POINTS, (CLOUD_TYPE,), "the map for keypoints, latched", Role.STATE,
        lambda localizer, landmarks: localizer.landmarks.use_map(landmarks), Reason.BAD_MAP,
        read=read_map, in_words="a map", latched=True, lasting=True,
    ),
    Input(
        topics.IMU, (IMU_TYPE,), "the IMU beside the camera", Role.SAMPLES,
        lambda localizer, reading: localizer.aid.add(reading), Reason.BAD_IMU, read=read_imu,
    ),
    Input(
        topics.CORRESPONDENCES, (CLOUD_TYPE,), "points of the map and their pixels", Role.FRAMES,
        lambda localizer, message: localizer.localize(message), Reason.BAD_CLOUD,
    ),
    Input(
        topics.KEYPOINTS, (CLOUD_TYPE,), "pixels with ids or descriptors, to be matched",
        Role.FRAMES, lambda localizer, message: localizer.localize_keypoints(message),
        Reason.BAD_KEYPOINTS, needs=topics.MAP_POINTS,
    ),
    Input(
        topics.DETECTIONS, (APRILTAG_TYPE, ISAAC_TYPE), "tags of another detector, with marker_map",
        Role.FRAMES, lambda localizer, message: localizer.localize_detections(message),
        Reason.BAD_DETECTIONS,
    ),
)
# fmt: on

INPUTS = {row.topic: row for row in _ROWS}
"""All inputs by name."""


def input_named(name: str) -> Input:
    """Return an input by its name; for a rig's camera ``NAME/correspondences`` and so on."""
    return INPUTS[name.rpartition("/")[2]]


def input_in_words(name: str) -> str:
    """Describe an input to a user who lacks it."""
    camera, _, own = name.rpartition("/")
    return f"{INPUTS[own].in_words} of {camera}" if camera else INPUTS[own].in_words


def with_role(role: Role) -> list[Input]:
    """Return the inputs of a role."""
    return [row for row in _ROWS if row.role == role]


_OWN = (topics.CAMERA_INFO, topics.CORRESPONDENCES, topics.KEYPOINTS)
"""Inputs that each camera of a rig has below its name."""


def inputs_of(config: NodeConfig) -> Mapping[str, Input]:
    """Return all inputs by name; of cameras with names ``NAME/correspondences`` and so on."""
    if not config.of_cameras:
        return INPUTS
    rows = {item.topic: item for item in INPUTS.values() if item.topic == topics.MAP_POINTS}
    named = [_of_camera(INPUTS[topic], name) for topic in _OWN for name in config.cameras]
    # What changes the state comes first.
    infos, frames = named[: len(config.cameras)], named[len(config.cameras) :]
    return {item.topic: item for item in (*infos, *rows.values(), *frames)}


def _of_camera(item: Input, name: str) -> Input:
    """Return the input of a camera with a name."""
    own = replace(item, topic=f"{name}/{item.topic}", about=f"{name}: {item.about}")
    if item.topic == topics.CAMERA_INFO:
        return replace(own, use=lambda localizer, found: localizer.calibrate(found, name))
    return replace(own, use=lambda localizer, message: localizer.add(name, item.topic, message))


def frame_localizer(
    config: NodeConfig, notice: Notify = unheard, transforms: Transforms | None = None
) -> FrameLocalizer:
    """Return the localizer of frames of a camera, or of a rig, with these settings.

    Raises:
        ValueError: for settings that the localizer refuses.
    """
    if config.of_cameras:
        from rs_localizer.pipeline.rig_frames import RigFrames

        return RigFrames(config, notice, transforms)
    from rs_localizer.pipeline.camera_frames import CameraFrames

    return CameraFrames(config, notice, transforms)
