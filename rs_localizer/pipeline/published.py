# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Published frames: their mounting on ``base_frame``, and transforms for TF.

``R = map_from_camera`` and ``p`` are the camera's pose, ``v, w`` its velocities in its own axes.
The mount ``camera_from_base`` has the rotation ``C`` and the translation ``r``, the base's origin
in camera axes. Pose, twist and errors of ``base_frame`` are:

    position   p + R r                 error  dp + theta x R r
    rotation   R C                     error  theta, about the fixed axes of the map
    linear     C' (v + w x r + r')     error  C' (dv + dw x r)
    angular    C' w + u                error  C' dw

``r'`` and ``u`` are the velocities of the base with respect to the camera, for a camera on a moving
head: of its origin in camera axes, and its turn in base axes. TF carries no covariance; the
extrinsics are treated as exact.
"""

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.config import NodeConfig, PublishTf
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Reason
from rs_localizer.io.outputs import BodyPose, Localized, Twist
from rs_localizer.io.transforms import NotYetError, Transform, TransformError, Transforms
from rs_localizer.pipeline.carried_pose import FoundPose, Odometry
from rs_localizer.pipeline.map_to_odom import CorrectionState, decide
from rs_localizer.pipeline.refusal import Refusal

_LINEAR, _ANGULAR = slice(0, 3), slice(3, 6)


def of_body(
    localized: Localized, config: NodeConfig, transforms: Transforms
) -> Localized | Refusal:
    """Return the result of ``base_frame`` from the result of the camera."""
    camera, base = localized.body_frame, config.base_frame
    if base in ("", camera):
        return localized
    # Without a time the latest transform is used, as everywhere in TF.
    timed = min(localized.input_stamp_ns, localized.stamp_ns) > 0
    stamp_ns, twist = localized.stamp_ns if timed else None, localized.twist
    try:
        mount, velocities = transforms.lookup(camera, base, stamp_ns), (np.zeros(3), np.zeros(3))
        half_ns = round(0.5e9 * localized.estimate.span) if twist and timed else 0
        if half_ns and transforms.moves(camera, base):
            before, after = (
                transforms.lookup(camera, base, localized.stamp_ns + side * half_ns)
                for side in (-1, 1)
            )
            velocities = _between(before, after, 2e-9 * half_ns)
    except TransformError as error:
        text = f"from the camera {camera!r} to base_frame {base!r}: {error}"
        return Refusal(Reason.NO_TRANSFORM, text)
    pose = base_pose(localized.pose, mount)
    twist = None if twist is None else base_twist(twist, mount, *velocities)
    return replace(localized, body_frame=base, pose=pose, twist=twist)


def _between(before: Transform, after: Transform, seconds: float) -> tuple[Array, Array]:
    """Return the velocities ``r'`` and ``u`` from one ``camera_from_base`` to another."""
    turn = so3.log(np.ascontiguousarray(before.rotation.T @ after.rotation))
    return (after.translation - before.translation) / seconds, turn / seconds


def base_pose(camera: BodyPose, mount: Transform) -> BodyPose:
    """Return the pose of the base in the map, from the pose of the camera."""
    lever, jacobian = camera.rotation @ mount.translation, np.eye(6)
    jacobian[_LINEAR, _ANGULAR] = -so3.hat(lever)
    return BodyPose(
        camera.position + lever,
        camera.rotation @ mount.rotation,
        _propagate(jacobian, camera.covariance),
    )


def base_twist(camera: Twist, mount: Transform, moving: Array, turning: Array) -> Twist:
    """Return the velocity of the base in the map, in base axes, from that of the camera.

    Args:
        moving: (3,) ``r'``, m/s.
        turning: (3,) ``u``, rad/s.
    """
    base_from_camera, lever = mount.rotation.T, mount.translation
    linear = camera.linear + np.cross(camera.angular, lever) + moving
    jacobian = np.zeros((6, 6))
    jacobian[_LINEAR, _LINEAR] = jacobian[_ANGULAR, _ANGULAR] = base_from_camera
    jacobian[_LINEAR, _ANGULAR] = -base_from_camera @ so3.hat(lever)
    return Twist(
        base_from_camera @ linear,
        base_from_camera @ camera.angular + turning,
        _propagate(jacobian, camera.covariance),
    )


def _propagate(jacobian: Array, covariance: Array) -> Array:
    result: Array = jacobian @ covariance @ jacobian.T
    return 0.5 * (result + result.T)  # rounding must not cost the symmetry


def is_mounting_late(transforms: Transforms, camera: str, base: str, time_ns: int) -> bool:
    """Return True if the mount is known for earlier times only."""
    if "" in (camera, base) or base == camera:
        return False
    try:
        transforms.lookup(camera, base, time_ns)
    except TransformError as error:
        return isinstance(error, NotYetError)
    return False


@dataclass(frozen=True, slots=True, eq=False)
class Broadcast:
    """One transform for TF."""

    stamp_ns: int
    parent: str
    child: str
    parent_from_child: Transform


def _check_time(frame: Localized) -> None:
    """Raise ``TransformError`` for a frame that says nothing of its time."""
    if frame.input_stamp_ns == 0:
        raise TransformError("header.stamp of the input is zero: the pose has no time for TF")


def pose_transform(frame: Localized) -> Broadcast:
    """Return the transform that is a frame's pose.

    Raises:
        TransformError: when the frame says nothing of its time.
    """
    _check_time(frame)
    map_from_body = Transform(frame.pose.rotation, frame.pose.position)
    return Broadcast(frame.stamp_ns, frame.map_frame, frame.body_frame, map_from_body)


def pose_in_odometry(frame: Localized, config: NodeConfig, transforms: Transforms) -> FoundPose:
    """Return a frame's pose with the odometry at its time, for :func:`.decide`.

    Raises:
        TransformError: when the frame says nothing of its time, or odometry says nothing for it, or
            the map is odometry's own frame.
    """
    _check_time(frame)
    if frame.map_frame == config.odom_frame:
        raise TransformError(f"the points are in {frame.map_frame!r}, which is odom_frame")
    odom_from_body = transforms.lookup(config.odom_frame, frame.body_frame, frame.stamp_ns)
    at = Odometry(frame.stamp_ns, odom_from_body)
    map_from_body = Transform(frame.pose.rotation, frame.pose.position)
    return FoundPose(at, map_from_body, frame.pose.covariance, frame.estimate.integrity)


def broadcast(
    frame: Localized, config: NodeConfig, transforms: Transforms, state: CorrectionState
) -> tuple[Broadcast | None, CorrectionState]:
    """Return the transform to publish of a frame, if any, and the next state of ``map -> odom``.

    Raises:
        TransformError: when the frame says nothing of its time, or odometry says nothing for it.
    """
    if config.publish_tf == PublishTf.NONE:
        return None, state
    if config.publish_tf == PublishTf.MAP_TO_CAMERA:
        return pose_transform(frame), state
    pose = pose_in_odometry(frame, config, transforms)
    decision = decide(config, state, pose)
    if (correction := decision.map_from_odom) is None:
        return None, decision.state
    ahead_ns = frame.stamp_ns + round(config.transform_tolerance * 1e9)
    return Broadcast(ahead_ns, frame.map_frame, config.odom_frame, correction), decision.state
