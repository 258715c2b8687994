"""What each reason for refusing a frame means, and what to look at: THE list, for users.

And the reasons for which an image is localized, but without the IMU.
"""

from __future__ import annotations

from enum import StrEnum
from typing import NamedTuple


class ImuReason(StrEnum):
    """Why an image was localized by the camera alone."""

    NEVER = "imu_never"
    LATE = "imu_late"
    STOPPED = "imu_stopped"
    BEGINS_LATER = "imu_begins_later"
    GAP = "imu_gap"
    TOO_SLOW = "imu_too_slow"
    SATURATED = "imu_saturated"
    NO_TRANSFORM = "imu_no_transform"
    NO_READOUT_TIME = "imu_no_readout_time"
    NOT_TRACKING = "imu_not_tracking"
    DOUBTED = "imu_doubted"
    DISAGREES = "imu_disagrees"
    TURNED = "imu_turned"


class Meaning(NamedTuple):
    """A reason in words."""

    means: str
    look_at: str


_TURNED = (
    "is the readout time in seconds, the scan direction right, are the pixels raw (not rectified)?"
)

REASONS = {
    "too_few_points": Meaning(
        "fewer points than min_inliers can be used",
        "show more of the map: three markers, or a larger part of it",
    ),
    "too_few_inliers": Meaning(
        "no motion fits min_inliers points to within inlier_threshold",
        f"do map and calibration belong to these images; {_TURNED}",
    ),
    "no_hypothesis": Meaning(
        "no sample of points gave a pose", "are all points the same, or on one line?"
    ),
    "behind_camera": Meaning(
        "most points would lie behind the camera", "is the map mirrored, or another one?"
    ),
    "residual": Meaning(
        "the errors of the inliers fill inlier_threshold: nothing fits them",
        f"calibration, map, or a too small inlier_threshold; {_TURNED}",
    ),
    "degenerate": Meaning(
        "the points do not determine the motion, as on a plane seen straight on",
        "look at it from an angle, show points at other depths, leave tracking and velocity_prior "
        "on",
    ),
    "implausible": Meaning(
        "the motion would be faster than a camera moves", f"mostly chance matches; {_TURNED}"
    ),
    "mirrored": Meaning(
        "points on a plane fit two poses, mirrored on it, alike",
        "come nearer, look from an angle, use a larger board or markers on several walls",
    ),
    "model_error": Meaning(
        "the errors of neighbouring points agree: vibration faster than the rows can tell, or a "
        "map or calibration that is wrong by more than a pose could bear",
        f"a stiffer mounting, the calibration, the map; {_TURNED}",
    ),
    "no_camera_info": Meaning(
        "no usable camera_info came before it", "is it recorded, is its topic the right one?"
    ),
    "bad_camera_info": Meaning(
        "a camera_info cannot be used", "calibrate; uncalibrated drivers publish zeros"
    ),
    "bad_cloud": Meaning(
        "a cloud of correspondences cannot be read", "its fields: x y z u v, FLOAT32 or FLOAT64"
    ),
    "bad_keypoints": Meaning(
        "a cloud of keypoints cannot be read", "its fields: u v and id and/or descriptor"
    ),
    "empty_cloud": Meaning("a cloud holds no point", "does the camera see anything of the map?"),
    "bad_map": Meaning(
        "a map on map_points cannot be used", "its fields: x y z and id and/or descriptor"
    ),
    "bad_imu": Meaning(
        "a message on imu cannot be used", "its units: rad/s and m/s^2; what its driver fills in"
    ),
    "no_map": Meaning("keypoints came before a map", "give map_file, or publish map_points"),
    "no_matches": Meaning(
        "no keypoint matches a landmark", "are descriptors, or ids, of map and camera of one kind?"
    ),
    "internal_error": Meaning(
        "a fault of this program, which goes on with the next frame", "please report the message"
    ),
    "no_transform": Meaning(
        "TF does not say where the camera is on base_frame",
        "record /tf and /tf_static, too; a robot_state_publisher has to run",
    ),
}
"""By the reason as it is counted, logged and published."""

IMU_REASONS: dict[str, Meaning] = {
    ImuReason.NEVER: Meaning("no message has come on imu", "is its topic remapped, does it run?"),
    ImuReason.LATE: Meaning(
        "the messages of the exposure come later than imu.wait, or by another clock",
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
        "messages come too rarely to tell how a camera shakes", "a rate of 100 Hz, better 200 Hz"
    ),
    ImuReason.SATURATED: Meaning(
        "the camera turns faster than the gyroscope can tell", "a larger range of the gyroscope"
    ),
    ImuReason.NO_TRANSFORM: Meaning(
        "TF does not say how the IMU is turned against the camera",
        "publish, or record, their transform on /tf_static; ROS needs tf2_ros for it",
    ),
    ImuReason.NO_READOUT_TIME: Meaning(
        "readout_time is 0 (unknown), and with it which message belongs to which row",
        "set readout_time; rs_localizer calibrate finds it",
    ),
    ImuReason.NOT_TRACKING: Meaning(
        "tracking is off, or solver knows no rolling shutter",
        "tracking: the gyroscope's bias is found from frame to frame",
    ),
    ImuReason.DOUBTED: Meaning(
        "the points of this image fit better without the gyroscope",
        "nothing, if it is rare; otherwise imu.gyroscope_noise, imu.time_offset",
    ),
    ImuReason.DISAGREES: Meaning(
        "the gyroscope does not turn as the camera does",
        "is it on the same body; imu.time_offset, the frame_id of its messages, their units",
    ),
    ImuReason.TURNED: Meaning(
        "the gyroscope turns as the camera does, but about other axes than TF says",
        "the transform between the two frame_ids; the angle is in the diagnostics",
    ),
}
"""Why an image was localized by the camera alone."""


def explained(reason: str) -> str:
    """One line about a reason; empty for one that is in no table."""
    meaning = {**REASONS, **IMU_REASONS}.get(reason)
    return "" if meaning is None else f"{meaning.means}; {meaning.look_at}"
