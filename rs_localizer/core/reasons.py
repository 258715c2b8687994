# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of what users are told: THE lists. docs/reasons.md says what each means and what to do."""

from dataclasses import dataclass
from enum import StrEnum


class Reason(StrEnum):
    """Reason for which there is no pose, or nothing to make one of."""

    TOO_FEW_POINTS = "too_few_points"
    TOO_FEW_INLIERS = "too_few_inliers"
    NO_HYPOTHESIS = "no_hypothesis"
    BEHIND_CAMERA = "behind_camera"
    RESIDUAL = "residual"
    DEGENERATE = "degenerate"
    MODEL_ERROR = "model_error"
    CALIBRATION = "calibration"
    UNCERTAIN = "uncertain"
    PRIOR = "prior"
    SCAN_AXIS = "scan_axis"
    AWAITS_FRAMES = "awaits_frames"
    NO_CAMERA_INFO = "no_camera_info"
    BAD_CAMERA_INFO = "bad_camera_info"
    BAD_CLOUD = "bad_cloud"
    BAD_KEYPOINTS = "bad_keypoints"
    EMPTY_CLOUD = "empty_cloud"
    BAD_MAP = "bad_map"
    BAD_IMU = "bad_imu"
    BAD_DETECTIONS = "bad_detections"
    NO_MAP = "no_map"
    NO_MATCHES = "no_matches"
    BAD_IMAGE = "bad_image"
    INTERNAL_ERROR = "internal_error"
    NO_STAMP = "no_stamp"
    REPEATED_STAMP = "repeated_stamp"
    REPEATED_IMAGE = "repeated_image"
    LATE_FRAME = "late_frame"
    NO_TRANSFORM = "no_transform"


class ImuReason(StrEnum):
    """Reason for which an image was localized by the camera alone."""

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


@dataclass(frozen=True, slots=True)
class Unused:
    """A reason for which a frame goes without its IMU, and what was found."""

    reason: ImuReason
    detail: str  # one sentence


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
