# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of what users are told: THE lists. docs/reasons.md says what each means and what to do."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from typing import Self

SETTINGS = "readout_time (in s), scan_direction, raw pixels (not rectified)"


class _Explained(StrEnum):
    """A name that is counted, logged and published, with its meaning in words."""

    means: str
    look_at: str  # what to check

    def __new__(cls, name: str, means: str, look_at: str) -> Self:
        member = str.__new__(cls, name)
        member._value_, member.means, member.look_at = name, means, look_at
        return member


class Reason(_Explained):
    """Reason for which there is no pose, or nothing to make one of."""

    # fmt: off
    TOO_FEW_POINTS = "too_few_points", "fewer points than min_inliers", "show more of the map"
    TOO_FEW_INLIERS = (
        "too_few_inliers", "no motion fits min_inliers points",
        f"check map, calibration, {SETTINGS}",
    )
    NO_HYPOTHESIS = (
        "no_hypothesis", "no sample of points gave a pose", "are all points alike, or on a line?"
    )
    BEHIND_CAMERA = (
        "behind_camera", "most points lie behind the camera", "is the map mirrored, or another one?"
    )
    RESIDUAL = (
        "residual", "inlier residuals reach inlier_threshold", f"check calibration, map, {SETTINGS}"
    )
    DEGENERATE = (
        "degenerate", "the points, such as a frontal plane, do not determine the motion",
        "look from an angle, show depth, keep tracking on",
    )
    MODEL_ERROR = (
        "model_error", "residuals depend on row or place in the image",
        f"vibration (IMU)? check calibration, map, {SETTINGS}",
    )
    CALIBRATION = (
        "calibration", "points fit a camera with another matrix",
        "is K, its binning or region of interest that of these images?",
    )
    UNCERTAIN = (
        "uncertain", "orientation known to worse than 4 degrees",
        "come nearer, show more of the map",
    )
    SCAN_AXIS = (
        "scan_axis", "scan_direction names the wrong axis", "set the one that the message names"
    )
    AWAITS_FRAMES = "awaits_frames", "output_lag waits for later frames", "nothing is wrong"
    NO_CAMERA_INFO = (
        "no_camera_info", "no usable camera_info yet", "is it recorded, is its topic right?"
    )
    BAD_CAMERA_INFO = (
        "bad_camera_info", "camera_info cannot be used",
        "calibrate; uncalibrated drivers send zeros",
    )
    BAD_CLOUD = (
        "bad_cloud", "correspondences cannot be read", "fields x y z u v, FLOAT32 or FLOAT64"
    )
    BAD_KEYPOINTS = "bad_keypoints", "keypoints cannot be read", "fields u v, and id or descriptor"
    EMPTY_CLOUD = "empty_cloud", "the cloud has no point", "does the camera see the map?"
    BAD_MAP = "bad_map", "map_points cannot be used", "fields x y z, and id or descriptor"
    BAD_IMU = "bad_imu", "imu cannot be used", "rad/s and m/s^2, filled in by its driver?"
    BAD_DETECTIONS = (
        "bad_detections", "detections cannot be used",
        "ids and four corners in pixels",
    )
    NO_MAP = (
        "no_map", "keypoints without a map, detections without marker_map",
        "map_file, map_points or marker_map",
    )
    NO_MATCHES = (
        "no_matches", "no keypoint or tag matches the map", "are descriptors, or ids, of one kind?"
    )
    BAD_IMAGE = (
        "bad_image", "the image cannot be read", "encodings: mono, colour, Bayer, YUV, JPEG, PNG"
    )
    INTERNAL_ERROR = "internal_error", "a fault of this program", "please report the message"
    NO_STAMP = (
        "no_stamp", "the image has no time: header.stamp is 0, or a video gives none",
        "have the driver set header.stamp; of a video, give --rate",
    )
    REPEATED_STAMP = "repeated_stamp", "this stamp came before", "two publishers?"
    REPEATED_IMAGE = (
        "repeated_image",
        "the pixels are those of an earlier image, bit for bit, of a camera that has moved since",
        "does the stream hang? webcams in the dark repeat images",
    )
    LATE_FRAME = "late_frame", "a newer frame came before", "nothing, if rare; two publishers?"
    NO_TRANSFORM = (
        "no_transform", "TF has no transform from camera to base_frame",
        "record /tf_static; robot_state_publisher",
    )
    # fmt: on


class ImuReason(_Explained):
    """Reason for which an image was localized by the camera alone."""

    # fmt: off
    NEVER = "imu_never", "no message has come on imu", "is its topic remapped, does it run?"
    LATE = (
        "imu_late", "messages come after imu.wait, or by another clock", "imu.wait, imu.time_offset"
    )
    STOPPED = "imu_stopped", "the last message is half a second old", "does it run, by this clock?"
    BEGINS_LATER = (
        "imu_begins_later", "the first message is younger than the image", "later: one clock?"
    )
    GAP = "imu_gap", "messages of the exposure are lost", "publish reliably"
    TOO_SLOW = "imu_too_slow", "messages are too rare to resolve vibration", "200 Hz"
    SATURATED = "imu_saturated", "faster than the gyroscope measures", "a larger range"
    NO_TRANSFORM = (
        "imu_no_transform", "TF has no transform from IMU to camera",
        "publish it on /tf_static; install tf2_ros",
    )
    NO_READOUT_TIME = (
        "imu_no_readout_time", "readout_time is 0: messages have no row",
        "rs_localizer calibrate finds it",
    )
    NOT_TRACKING = "imu_not_tracking", "the solver is for global shutters", "another solver"
    DOUBTED = (
        "imu_doubted", "the rotation within and before the image is not the gyroscope's",
        "if often: imu.gyroscope_noise, imu.time_offset",
    )
    DISAGREES = (
        "imu_disagrees", "the gyroscope's rates are not the camera's",
        "one body? imu.time_offset, the transform of the frame_ids, units",
    )
    # fmt: on


@dataclass(frozen=True, slots=True)
class Unused:
    """A reason for which a frame goes without its IMU, and what was found."""

    reason: ImuReason
    detail: str = ""


class Notice(StrEnum):
    """Oddity that is no reason to refuse anything."""

    # Notices about frames.
    TIME_WENT_BACK = "time_went_back"
    MAP_CHANGED = "map_changed"
    CAMERA_CHANGED = "camera_changed"
    MAP_IS_CAMERA = "map_is_camera"
    COARSE_COORDINATES = "coarse_coordinates"
    PIXELS_OUTSIDE = "pixels_outside"
    TOO_MANY_POINTS = "too_many_points"
    MAP_SCALE = "map_scale"
    STILL_IMAGE = "still_image"
    WOULD_FIT = "would_fit"
    PRIOR_REFUSED = "prior_refused"
    POSE_GIVEN = "pose_given"
    DOUBTFUL = "doubtful"
    STALE_LANDMARKS = "stale_landmarks"
    READOUT_TIME = "readout_time"
    LENS = "lens"
    EXTRINSICS = "extrinsics"
    # Notices about maps and keypoints.
    MAP_REPLACED = "map_replaced"
    MAP_INCOMPLETE = "map_incomplete"
    TOO_MANY_KEYPOINTS = "too_many_keypoints"
    # Notices about markers in images.
    UNKNOWN_MARKERS = "unknown_markers"
    REPEATED_MARKERS = "repeated_markers"
    OTHER_BOARD = "other_board"
    # Notices of nodes.
    NOT_BROADCAST = "not_broadcast"
    MAP_JUMPED = "map_jumped"
    CONTRADICTED = "contradicted"
    SECOND_BROADCASTER = "second_broadcaster"
    TIME_JUMPED = "time_jumped"
    TWO_PUBLISHERS = "two_publishers"
    INCOMPATIBLE_PUBLISHER = "incompatible_publisher"
    NO_POSE = "no_pose"
    NO_IMAGES = "no_images"
