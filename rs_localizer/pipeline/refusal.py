# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A message without a result, and why; who is told what is odd."""

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
    """What is read of a message; refused for this reason if it cannot be, or as empty."""
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


SETTINGS = "is readout_time in seconds, scan_direction right, are the pixels raw (not rectified)?"

REASONS: dict[str, Meaning] = {
    Reason.TOO_FEW_POINTS: Meaning(
        "fewer usable points than min_inliers", "show three markers, or a larger part of the map"
    ),
    Reason.TOO_FEW_INLIERS: Meaning(
        "no motion fits min_inliers points",
        f"do map and calibration belong to these images; {SETTINGS}",
    ),
    Reason.NO_HYPOTHESIS: Meaning(
        "no sample of points gave a pose", "are all points the same, or on one line?"
    ),
    Reason.BEHIND_CAMERA: Meaning(
        "most points would lie behind the camera", "is the map mirrored, or another one?"
    ),
    Reason.RESIDUAL: Meaning(
        "inlier residuals are as large as inlier_threshold allows", f"calibration, map; {SETTINGS}"
    ),
    Reason.DEGENERATE: Meaning(
        "the points do not determine the motion, e.g. a frontoparallel plane",
        "look from an angle, show other depths, leave tracking and velocity_prior on",
    ),
    Reason.IMPLAUSIBLE: Meaning(
        "the motion exceeds what a camera can do", f"mostly chance matches; {SETTINGS}"
    ),
    Reason.MIRRORED: Meaning(
        "planar pose ambiguity: two mirrored poses fit equally well",
        "come nearer, look from an angle, use markers on several walls",
    ),
    Reason.MODEL_ERROR: Meaning(
        "errors that no motion explains, of rows or smooth over the image",
        f"vibration (stiffer mounting, IMU), calibration, map; {SETTINGS}",
    ),
    Reason.UNCERTAIN: Meaning(
        "orientation uncertainty exceeds max_orientation_deviation",
        "come nearer, show more of the map, leave tracking on, or raise the limit",
    ),
    Reason.SCAN_AXIS: Meaning(
        "scan_direction names the wrong axis: columns, or rows",
        "set the direction that the message names (drivers may rotate images)",
    ),
    Reason.AWAITS_FRAMES: Meaning(
        "output_lag holds results back until later frames have come", "nothing is wrong"
    ),
    Reason.NO_CAMERA_INFO: Meaning(
        "no usable camera_info came before it", "is it recorded, is its topic the right one?"
    ),
    Reason.BAD_CAMERA_INFO: Meaning(
        "a camera_info cannot be used", "calibrate; uncalibrated drivers publish zeros"
    ),
    Reason.BAD_CLOUD: Meaning(
        "a cloud of correspondences cannot be read", "its fields: x y z u v, FLOAT32 or FLOAT64"
    ),
    Reason.BAD_KEYPOINTS: Meaning(
        "a cloud of keypoints cannot be read", "its fields: u v and id and/or descriptor"
    ),
    Reason.EMPTY_CLOUD: Meaning(
        "a cloud holds no point", "does the camera see anything of the map?"
    ),
    Reason.BAD_MAP: Meaning(
        "a map on map_points cannot be used", "its fields: x y z and id and/or descriptor"
    ),
    Reason.BAD_IMU: Meaning(
        "a message on imu cannot be used", "its units: rad/s and m/s^2; what its driver fills in"
    ),
    Reason.BAD_DETECTIONS: Meaning(
        "detections cannot be used, or have another order of corners",
        "apriltag's order: lower left, lower right, upper right, upper left",
    ),
    Reason.NO_MAP: Meaning(
        "keypoints came before a map, or detections without marker_map",
        "map_file or map_points; marker_map for detections",
    ),
    Reason.NO_MATCHES: Meaning(
        "no keypoint matches a landmark, or no tag is in marker_map",
        "are descriptors, or ids, of one kind?",
    ),
    Reason.BAD_IMAGE: Meaning(
        "an image cannot be read", "its encoding: mono, color, Bayer, YUV, JPEG, PNG"
    ),
    Reason.NO_TIME: Meaning(
        "OpenCV gives no presentation time for an image of a video",
        "--rate, or another container; the image is left out",
    ),
    Reason.INTERNAL_ERROR: Meaning(
        "a fault of this program, which continues with the next frame", "please report the message"
    ),
    Reason.REPEATED_STAMP: Meaning(
        "a frame with this stamp has come already",
        "two publishers on this topic, or a driver that stamps anew?",
    ),
    Reason.LATE_FRAME: Meaning(
        "a newer frame came before it; from half a second on, tracking restarts",
        "nothing, if it is rare; else, do two senders use this topic?",
    ),
    Reason.COMPILING: Meaning(
        "kernels of this frame are being compiled (first start)",
        "it ends within minutes; `rs_localizer warm` beforehand",
    ),
    Reason.NO_TRANSFORM: Meaning(
        "TF has no transform from the camera to base_frame",
        "record /tf and /tf_static, run a robot_state_publisher",
    ),
}
"""By the reason as it is counted, logged and published."""

IMU_REASONS: dict[str, Meaning] = {
    ImuReason.NEVER: Meaning("no message has come on imu", "is its topic remapped, does it run?"),
    ImuReason.LATE: Meaning(
        "IMU messages arrive later than imu.wait or use another clock",
        "a larger imu.wait, imu.time_offset, its driver",
    ),
    ImuReason.STOPPED: Meaning(
        "the last message is older than the image by half a second or more",
        "does it still run, by the camera's clock?",
    ),
    ImuReason.BEGINS_LATER: Meaning(
        "the first remembered message is younger than the image",
        "nothing, at the beginning; else, is there one clock?",
    ),
    ImuReason.GAP: Meaning(
        "messages of the exposure are lost", "a reliable publisher, a machine with less to do"
    ),
    ImuReason.TOO_SLOW: Meaning(
        "messages arrive too rarely to resolve vibration", "a rate of 100 Hz, better 200 Hz"
    ),
    ImuReason.SATURATED: Meaning(
        "the camera turns faster than the gyroscope can measure", "a larger range of the gyroscope"
    ),
    ImuReason.NO_TRANSFORM: Meaning(
        "TF has no transform from the IMU to the camera",
        "publish it on /tf_static; ROS needs tf2_ros for it",
    ),
    ImuReason.NO_READOUT_TIME: Meaning(
        "readout_time is 0: unknown which message belongs to which row",
        "set readout_time; rs_localizer calibrate finds it",
    ),
    ImuReason.NOT_TRACKING: Meaning("the solver is for global shutters", "another solver"),
    ImuReason.DOUBTED: Meaning(
        "this image fits better without the gyroscope, or its stamps have stepped",
        "nothing, if rare; imu.gyroscope_noise, imu.time_offset",
    ),
    ImuReason.DISAGREES: Meaning(
        "the gyroscope's rates disagree with the camera's motion",
        "one body? imu.time_offset, its frame_id and units",
    ),
    ImuReason.TURNED: Meaning(
        "the gyroscope's axes disagree with TF", "the transform between the two frame_ids"
    ),
    ImuReason.COMPILING: Meaning(
        "kernels for an IMU are being compiled (first start)",
        "it ends within minutes; `rs_localizer warm` beforehand",
    ),
}
"""Why an image was localized by the camera alone."""


def explained(reason: str) -> str:
    """One line about a reason; empty for one that is in no table."""
    meaning = {**REASONS, **IMU_REASONS}.get(reason)
    return "" if meaning is None else f"{meaning.means}; {meaning.look_at}"
