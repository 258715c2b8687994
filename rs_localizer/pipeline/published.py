"""From an estimate to what is published of it: the moment, the velocities, and the body."""

from __future__ import annotations

from dataclasses import dataclass, replace

from rs_localizer.config import NodeConfig, OrientationCovariance
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Reason
from rs_localizer.core.types import Estimate
from rs_localizer.io.clouds import Correspondences, select_inliers
from rs_localizer.io.outputs import Localized
from rs_localizer.io.transforms import NotYetError, TransformError, Transforms
from rs_localizer.pipeline.body import about_angles, base_pose, base_twist, find_mounting
from rs_localizer.pipeline.pose_at_time import (
    backwards,
    either,
    pose_at,
    published_moment,
    twist_at,
    with_timing,
)
from rs_localizer.pipeline.refusal import Refusal, Waiting
from rs_localizer.solvers.table import find_solver


@dataclass(frozen=True, slots=True)
class ReadoutKnown:
    """How well the readout time is known."""

    deviation: float  # s
    may_be_reversed: bool  # rows may run the other way
    global_shutter: bool  # all rows are exposed at once, whatever is set


def of_camera(
    cloud: Correspondences,
    estimate: Estimate,
    config: NodeConfig,
    camera: Camera,
    frame: str,
    known: ReadoutKnown,
) -> Localized:
    """Pose and twist of the camera's optical frame, of this name, at the published moment.

    Args:
        known: of the readout time.
    """
    readout_time = config.readout_time
    stamp_ns, tau = published_moment(config, camera, cloud.stamp_ns)
    moving = readout_time > 0.0 and find_solver(config.solver).rolling_shutter
    if known.global_shutter and estimate.turn is None:
        moving = False  # an image says nothing of velocities
    pose = pose_at(estimate, tau)
    twist = twist_at(estimate, tau, readout_time) if moving else None
    deviation = known.deviation
    if twist is not None and known.may_be_reversed:
        other = pose_at(estimate, -tau)
        pose, twist = either(pose, other), backwards(twist)
    if twist is not None and deviation > 0.0:
        # The middle row comes later where the readout takes longer; the first one does not.
        delay = deviation * camera.first_row_time if tau == 0.0 else 0.0
        share = deviation / readout_time
        pose, twist = with_timing(pose, twist, share, delay, config.acceleration)
    return Localized(
        input_stamp_ns=cloud.stamp_ns,
        stamp_ns=stamp_ns,
        map_frame=cloud.frame,
        body_frame=frame,
        pose=pose,
        twist=twist,
        inliers=select_inliers(cloud.table, estimate.inliers, estimate.residuals),
        dropped=cloud.dropped,
        estimate=estimate,
    )


def of_body(
    localized: Localized, config: NodeConfig, transforms: Transforms
) -> Localized | Refusal:
    """The same of ``base_frame``, from that of the camera, with the covariance that is wanted."""
    found = _mounted(localized, config, transforms)
    if found and config.orientation_covariance == OrientationCovariance.ROLL_PITCH_YAW:
        return replace(found, pose=about_angles(found.pose))
    return found


def _mounted(
    localized: Localized, config: NodeConfig, transforms: Transforms
) -> Localized | Refusal:
    base = config.base_frame
    if base in ("", localized.body_frame):
        return localized
    # Who gives no time gets the latest, as everywhere in TF.
    timed = min(localized.input_stamp_ns, localized.stamp_ns) > 0
    stamp_ns = localized.stamp_ns if timed else None
    span_ns = round(config.readout_time * 1e9) if localized.twist else 0
    try:
        mounting = find_mounting(transforms, localized.body_frame, base, stamp_ns, span_ns)
    except TransformError as error:
        text = f"from the camera {localized.body_frame!r} to base_frame {base!r}: {error}"
        if not isinstance(error, NotYetError):
            return Refusal(Reason.NO_TRANSFORM, text)
        patience = config.transform_tolerance
        return Waiting(
            Reason.NO_TRANSFORM, text, lambda: of_body(localized, config, transforms), patience
        )
    return replace(
        localized,
        body_frame=base,
        pose=base_pose(localized.pose, mounting),
        twist=base_twist(localized.twist, mounting) if localized.twist else None,
    )
