"""What each reason for refusing a frame means, and what to look at: THE list, for users."""

from __future__ import annotations

from typing import NamedTuple


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


def explained(reason: str) -> str:
    """One line about a reason; empty for one that is not in the table."""
    meaning = REASONS.get(reason)
    return "" if meaning is None else f"{meaning.means}; {meaning.look_at}"
