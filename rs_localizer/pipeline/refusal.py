# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A refused message and its reason; the call that reports oddities."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypeVar

from rs_localizer.core.reasons import ImuReason, Notice, Reason
from rs_localizer.io.clouds import EmptyCloudError
from rs_localizer.io.messages import MessageError

Read = TypeVar("Read")


@dataclass(frozen=True, slots=True)
class Refusal:
    """A message without a result; false in a condition. What its reason means: :mod:`.reasons`."""

    reason: Reason
    detail: str  # one sentence that says what was found

    def __bool__(self) -> Literal[False]:
        return False


@dataclass(frozen=True, slots=True)
class Waiting(Refusal):
    """A localized frame whose mounting is known for earlier times only.

    It is refused, unless somebody asks for it again.
    """

    again: Callable[[], Any]  # the result or another refusal
    patience: float  # s, for which this makes sense


Notify = Callable[[Notice | ImuReason, str], None]
"""Told of what is odd, with one sentence. Frames are localized all the same."""


def unheard(notice: Notice | ImuReason, text: str) -> None:
    """Tell nobody."""


def read_or_refuse(read: Callable[[Any], Read], message: Any, reason: Reason) -> Read | Refusal:
    """Read a message, or refuse it for this reason, or as empty."""
    try:
        return read(message)
    except EmptyCloudError as error:
        return Refusal(Reason.EMPTY_CLOUD, str(error))
    except MessageError as error:
        return Refusal(reason, str(error))


class Meaning(NamedTuple):
    """A reason in words."""

    means: str
    look_at: str


SETTINGS = "readout_time (in s), scan_direction, raw pixels (not rectified)"

REASONS: dict[str, Meaning] = {
    Reason.TOO_FEW_POINTS: Meaning("fewer points than min_inliers", "show more of the map"),
    Reason.TOO_FEW_INLIERS: Meaning(
        "no motion fits min_inliers points",
        f"check map, calibration, {SETTINGS}",
    ),
    Reason.NO_HYPOTHESIS: Meaning(
        "no sample of points gave a pose", "are all points alike, or on a line?"
    ),
    Reason.BEHIND_CAMERA: Meaning(
        "most points lie behind the camera", "is the map mirrored, or another one?"
    ),
    Reason.RESIDUAL: Meaning(
        "inlier residuals reach inlier_threshold", f"check calibration, map, {SETTINGS}"
    ),
    Reason.DEGENERATE: Meaning(
        "the points, such as a frontal plane, do not determine the motion",
        "look from an angle, show depth, keep tracking on",
    ),
    Reason.MODEL_ERROR: Meaning(
        "residuals depend on row or place in the image",
        f"vibration (IMU)? check calibration, map, {SETTINGS}",
    ),
    Reason.CALIBRATION: Meaning(
        "points fit a camera with another matrix",
        "is K, its binning or region of interest that of these images?",
    ),
    Reason.UNCERTAIN: Meaning(
        "orientation deviation above max_orientation_deviation",
        "come nearer, show more of the map",
    ),
    Reason.SCAN_AXIS: Meaning(
        "scan_direction names the wrong axis", "set the one that the message names"
    ),
    Reason.AWAITS_FRAMES: Meaning("output_lag waits for later frames", "nothing is wrong"),
    Reason.NO_CAMERA_INFO: Meaning(
        "no usable camera_info yet", "is it recorded, is its topic right?"
    ),
    Reason.BAD_CAMERA_INFO: Meaning(
        "camera_info cannot be used", "calibrate; uncalibrated drivers send zeros"
    ),
    Reason.BAD_CLOUD: Meaning(
        "correspondences cannot be read", "fields x y z u v, FLOAT32 or FLOAT64"
    ),
    Reason.BAD_KEYPOINTS: Meaning("keypoints cannot be read", "fields u v, and id or descriptor"),
    Reason.EMPTY_CLOUD: Meaning("the cloud has no point", "does the camera see the map?"),
    Reason.BAD_MAP: Meaning("map_points cannot be used", "fields x y z, and id or descriptor"),
    Reason.BAD_IMU: Meaning("imu cannot be used", "rad/s and m/s^2, filled in by its driver?"),
    Reason.BAD_DETECTIONS: Meaning(
        "detections cannot be used, or their order of corners",
        "apriltag's order: lower left, lower right, upper right, upper left",
    ),
    Reason.NO_MAP: Meaning(
        "keypoints without a map, detections without marker_map",
        "map_file, map_points or marker_map",
    ),
    Reason.NO_MATCHES: Meaning(
        "no keypoint or tag matches the map", "are descriptors, or ids, of one kind?"
    ),
    Reason.BAD_IMAGE: Meaning(
        "the image cannot be read", "encodings: mono, colour, Bayer, YUV, JPEG, PNG"
    ),
    Reason.INTERNAL_ERROR: Meaning("a fault of this program", "please report the message"),
    Reason.NO_STAMP: Meaning(
        "the image has no time: header.stamp is 0, or a video gives none",
        "have the driver set header.stamp; of a video, give --rate",
    ),
    Reason.REPEATED_STAMP: Meaning("this stamp came before", "two publishers?"),
    Reason.REPEATED_IMAGE: Meaning(
        "the pixels are those of an earlier image, bit for bit, of a camera that has moved since",
        "does the stream hang? webcams in the dark repeat images",
    ),
    Reason.LATE_FRAME: Meaning("a newer frame came before", "nothing, if rare; two publishers?"),
    Reason.NO_TRANSFORM: Meaning(
        "TF has no transform from camera to base_frame",
        "record /tf_static; robot_state_publisher",
    ),
}
"""By the reason as it is counted, logged and published."""

IMU_REASONS: dict[str, Meaning] = {
    ImuReason.NEVER: Meaning("no message has come on imu", "is its topic remapped, does it run?"),
    ImuReason.LATE: Meaning(
        "messages come after imu.wait, or by another clock",
        "imu.wait, imu.time_offset",
    ),
    ImuReason.STOPPED: Meaning(
        "the last message is half a second old",
        "does it run, by this clock?",
    ),
    ImuReason.BEGINS_LATER: Meaning(
        "the first message is younger than the image", "later: one clock?"
    ),
    ImuReason.GAP: Meaning("messages of the exposure are lost", "publish reliably"),
    ImuReason.TOO_SLOW: Meaning("messages are too rare to resolve vibration", "200 Hz"),
    ImuReason.SATURATED: Meaning("faster than the gyroscope measures", "a larger range"),
    ImuReason.NO_TRANSFORM: Meaning(
        "TF has no transform from IMU to camera",
        "publish it on /tf_static; install tf2_ros",
    ),
    ImuReason.NO_READOUT_TIME: Meaning(
        "readout_time is 0: messages have no row", "rs_localizer calibrate finds it"
    ),
    ImuReason.NOT_TRACKING: Meaning("the solver is for global shutters", "another solver"),
    ImuReason.DOUBTED: Meaning(
        "the rotation within and before the image is not the gyroscope's",
        "if often: imu.gyroscope_noise, imu.time_offset",
    ),
    ImuReason.DISAGREES: Meaning(
        "the gyroscope's rates are not the camera's",
        "one body? imu.time_offset, the transform of the frame_ids, units",
    ),
}
"""Why an image was localized by the camera alone."""


def explained(reason: str) -> str:
    """Explain a reason in one line; empty for one that is in no table."""
    meaning = {**REASONS, **IMU_REASONS}.get(reason)
    return "" if meaning is None else f"{meaning.means}; {meaning.look_at}"
