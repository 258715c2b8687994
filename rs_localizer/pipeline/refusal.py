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


SETTINGS = (
    "is the readout time in seconds, the scan direction right, are the pixels raw (not rectified)?"
)

REASONS: dict[str, Meaning] = {
    Reason.TOO_FEW_POINTS: Meaning(
        "fewer points than min_inliers can be used",
        "show more of the map: three markers, or a larger part of it",
    ),
    Reason.TOO_FEW_INLIERS: Meaning(
        "no motion fits min_inliers points to within inlier_threshold",
        f"do map and calibration belong to these images; {SETTINGS}",
    ),
    Reason.NO_HYPOTHESIS: Meaning(
        "no sample of points gave a pose", "are all points the same, or on one line?"
    ),
    Reason.BEHIND_CAMERA: Meaning(
        "most points would lie behind the camera", "is the map mirrored, or another one?"
    ),
    Reason.RESIDUAL: Meaning(
        "inlier residuals are as large as inlier_threshold allows; no pose fits",
        f"calibration, map, or a too small inlier_threshold; {SETTINGS}",
    ),
    Reason.DEGENERATE: Meaning(
        "the points do not determine the motion, e.g. a frontoparallel plane",
        "look at it from an angle, show points at other depths, leave tracking and velocity_prior "
        "on",
    ),
    Reason.IMPLAUSIBLE: Meaning(
        "the motion exceeds what a camera can do", f"mostly chance matches; {SETTINGS}"
    ),
    Reason.MIRRORED: Meaning(
        "planar pose ambiguity: two poses, mirrored about the line of sight, fit equally well",
        "come nearer, look from an angle, use a larger board or markers on several walls",
    ),
    Reason.MODEL_ERROR: Meaning(
        "errors that no motion explains: of neighbouring rows, of points just beyond the inlier "
        "gate, or smooth over the image",
        f"vibration (a stiffer mounting, an IMU), calibration, map; {SETTINGS}",
    ),
    Reason.UNCERTAIN: Meaning(
        "orientation uncertainty exceeds max_orientation_deviation, as before a small plane",
        "come nearer, use a larger board or markers on several walls; leave tracking on, or raise "
        "the limit where a filter weighs each pose",
    ),
    Reason.SCAN_AXIS: Meaning(
        "the shutter scans columns instead of rows, or rows instead of columns: scan_direction "
        "names the wrong axis",
        "set scan_direction to the direction that the message names; a driver that rotates images "
        "rotates the scan, too",
    ),
    Reason.AWAITS_FRAMES: Meaning(
        "output_lag holds results back until so many later frames have come",
        "nothing is wrong: the first frames have none yet",
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
        "a message on detections cannot be used, or its corners come in another order",
        "lower left, lower right, upper right, upper left, as apriltag has them",
    ),
    Reason.NO_MAP: Meaning(
        "keypoints came before a map, or detections without marker_map",
        "give map_file, or publish map_points; marker_map for detections",
    ),
    Reason.NO_MATCHES: Meaning(
        "no keypoint matches a landmark, or no detected tag is in marker_map",
        "are descriptors, or ids, of map and camera of one kind?",
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
        "does a second node, or a recording, publish on this topic; does the driver stamp anew?",
    ),
    Reason.LATE_FRAME: Meaning(
        "a newer frame came before it; from half a second on, the previous frames are forgotten",
        "nothing, if it is rare; otherwise, do two senders use this topic?",
    ),
    Reason.COMPILING: Meaning(
        "kernels of this frame are being compiled, at the first start on a machine",
        "it ends within minutes; `rs_localizer warm` beforehand",
    ),
    Reason.NO_TRANSFORM: Meaning(
        "TF has no transform from the camera to base_frame",
        "record /tf and /tf_static, too; a robot_state_publisher has to run",
    ),
}
"""By the reason as it is counted, logged and published."""

IMU_REASONS: dict[str, Meaning] = {
    ImuReason.NEVER: Meaning("no message has come on imu", "is its topic remapped, does it run?"),
    ImuReason.LATE: Meaning(
        "IMU messages arrive later than imu.wait or use another clock",
        "a larger imu.wait, imu.time_offset, the driver of the IMU",
    ),
    ImuReason.STOPPED: Meaning(
        "the last message is older than the image by half a second or more",
        "does the IMU still run; do camera and IMU have one clock?",
    ),
    ImuReason.BEGINS_LATER: Meaning(
        "the first message that is remembered is younger than the image",
        "nothing, at the beginning; otherwise, do camera and IMU have one clock?",
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
    ImuReason.TWO_FRAMES: Meaning(
        "messages on imu alternate between two frame_ids",
        "two IMUs, or two drivers, publish on one topic: remap one of them",
    ),
    ImuReason.NO_TRANSFORM: Meaning(
        "TF has no transform from the IMU to the camera",
        "publish, or record, their transform on /tf_static; ROS needs tf2_ros for it",
    ),
    ImuReason.NO_READOUT_TIME: Meaning(
        "readout_time is 0 (unknown), and with it which message belongs to which row",
        "set readout_time; rs_localizer calibrate finds it",
    ),
    ImuReason.NOT_TRACKING: Meaning("the solver is for global shutters", "another solver"),
    ImuReason.DOUBTED: Meaning(
        "the points of this image fit better without the gyroscope, or its stamps have stepped",
        "nothing, if it is rare; otherwise imu.gyroscope_noise, imu.time_offset",
    ),
    ImuReason.DISAGREES: Meaning(
        "the gyroscope's rates disagree with the camera's motion",
        "is it on the same body; imu.time_offset, the frame_id of its messages, their units",
    ),
    ImuReason.TURNED: Meaning(
        "the gyroscope's axes disagree with TF",
        "the transform between the two frame_ids; the angle is in the diagnostics",
    ),
    ImuReason.COMPILING: Meaning(
        "kernels for an IMU are being compiled, at the first start on a machine",
        "it ends within minutes; `rs_localizer warm` beforehand",
    ),
}
"""Why an image was localized by the camera alone."""


def explained(reason: str) -> str:
    """One line about a reason; empty for one that is in no table."""
    meaning = {**REASONS, **IMU_REASONS}.get(reason)
    return "" if meaning is None else f"{meaning.means}; {meaning.look_at}"
