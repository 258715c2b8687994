# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A pose that others know, as a prior of frames that no frame before predicts.

A user's click in RViz, a filter's pose: where no track is, the frame is
looked for near it, within its covariance, before it is searched for everywhere. Points that
disagree count more. While there is a track it says nothing: a filter's pose has our own in it.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Notice
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import Prior
from rs_localizer.io.messages import MessageError, stamp_ns
from rs_localizer.io.outputs import BodyPose
from rs_localizer.io.transforms import Transform, TransformError, from_numbers
from rs_localizer.pipeline.aid import Moment
from rs_localizer.pipeline.published import base_pose
from rs_localizer.pipeline.refusal import Notify

# Deviations (m, rad) that a variance of zero stands for: RViz leaves z, roll and pitch at zero.
_UNSAID = (0.1, 0.05)
# Nobody knows a pose better beforehand than it is worth: m, rad.
_LEAST = (0.01, 0.005)
_OLDEST = 10.0  # s
_UNKNOWN = 1e12  # m^2, rad^2: a variance as large says nothing
_ROUNDING = 1e-6  # of an eigenvalue of correlations: filters compute with single precision
# Squared distance of six numbers from what was given that one pose in ten thousand has.
_FAR = 27.9


@dataclass(frozen=True, slots=True, eq=False)
class GivenPose:
    """A pose and its covariance, as it came."""

    stamp_ns: int  # 0: of now
    frame: str  # of the map
    body: str  # frame of the body; empty: base_frame, or the camera
    pose: Transform  # map_from_body
    covariance: Array  # (6,6) x y z, rotations about the axes of the map

    @property
    def lasts(self) -> bool:
        """True for a filter's pose: others will follow."""
        return bool(self.body)

    @property
    def allowed(self) -> Array:
        """Its covariance (6,6), with what nobody has said or can know better."""
        least = np.repeat(_LEAST, 3)
        unsaid = np.where(self.covariance.diagonal() > 0.0, least, np.repeat(_UNSAID, 3))
        allowed: Array = self.covariance + np.diag(unsaid**2)
        return allowed


def read_given_pose(message: Any) -> GivenPose:
    """Read a PoseWithCovarianceStamped, or an Odometry.

    Raises:
        MessageError: for numbers that are no pose or no covariance.
    """
    at, q = message.pose.pose.position, message.pose.pose.orientation
    try:
        pose = from_numbers((at.x, at.y, at.z), (q.x, q.y, q.z, q.w))
    except TransformError as error:
        raise MessageError(f"the given pose is none: {error}") from error
    spread = np.array(message.pose.covariance, float).reshape(6, 6)
    if not np.isfinite(spread).all():
        raise MessageError("the covariance of the given pose holds numbers that are not finite")
    if (variances := spread.diagonal()).min() < 0.0:
        raise MessageError(f"the given pose has variances below zero: {variances.tolist()}")
    # Some write the largest number there is for what they do not know.
    shrunk = np.sqrt(_UNKNOWN / np.maximum(variances, _UNKNOWN))
    spread = np.outer(shrunk, shrunk) * (0.5 * spread + 0.5 * spread.T)
    scale = np.sqrt(np.where(variances > 0.0, np.minimum(variances, _UNKNOWN), 1.0))
    if (least := np.linalg.eigvalsh(spread / np.outer(scale, scale))[0]) < -_ROUNDING:
        raise MessageError(
            f"the given pose has no covariance: its correlations have an eigenvalue of {least:.2g}"
        )
    frame = message.header.frame_id.removeprefix("/")
    body = getattr(message, "child_frame_id", "").removeprefix("/")
    return GivenPose(stamp_ns(message), frame, body, pose, spread)


class PosePrior:
    """Keeps a given pose until a frame has been found by it, or it is too old.

    Args:
        notice: told why it is not used.
    """

    def __init__(self, notice: Notify) -> None:
        self._notice = notice
        self.given: GivenPose | None = None
        """What waits for a frame."""
        self._expected: Prior | None = None

    def prior(self, at: Moment, map_frame: str) -> Prior | None:
        """Return the prior of the camera's motion at a time; None if no pose was given."""
        self._expected = None
        given = self.given
        if given is None:
            return None
        seconds = abs(at.time_ns - given.stamp_ns) * 1e-9 if given.stamp_ns else 0.0
        body = given.body or at.config.base_frame or at.camera_frame
        try:
            if given.frame != map_frame:
                raise TransformError(f"it is in {given.frame!r}, the points are in {map_frame!r}")
            if seconds > _OLDEST:
                raise TransformError(f"it is {seconds:.0f} s older, or newer, than the frame")
            body_from_camera = (
                Transform(np.eye(3), np.zeros(3))
                if body == at.camera_frame
                else at.transforms.lookup(body, at.camera_frame, None)
            )
        except TransformError as error:
            self._notice(Notice.PRIOR_REFUSED, f"the given pose is not used: {error}")
            self.given = None
            return None
        self._expected = _of_camera(given, body_from_camera, seconds, at.config)
        return self._expected

    def judge_result(self, result: Estimate) -> None:
        """Drop the given pose, now that a frame has a pose."""
        given, expected = self.given, self._expected
        if given is None or expected is None:
            return
        assert expected.motion is not None
        assert expected.covariance is not None
        turn = so3.log(np.ascontiguousarray(expected.motion.rotation @ result.rotation.T))
        centre = -expected.motion.rotation.T @ expected.motion.translation
        off = np.concatenate([turn, expected.motion.rotation @ (result.position - centre)])
        spread = expected.covariance[:6, :6] + result.covariance[:6, :6]
        if off @ np.linalg.solve(spread, off) > _FAR:
            self._notice(
                Notice.PRIOR_REFUSED,
                f"the points disagree with the given pose, by {np.linalg.norm(off[3:]):.2f} m and "
                f"{np.degrees(np.linalg.norm(turn)):.0f} degrees",
            )
        self._expected = None
        if not given.lasts:
            self.given = None


def _of_camera(
    given: GivenPose, body_from_camera: Transform, seconds: float, config: NodeConfig
) -> Prior:
    """Return the prior of a camera that may have moved for this long, as cameras do."""
    pace = [config.velocity_prior.linear, config.velocity_prior.angular]
    moved = np.repeat(np.square(np.multiply(pace, seconds)), 3)
    covariance = given.allowed + np.diag(moved)
    body = BodyPose(given.pose.translation, given.pose.rotation, covariance)
    camera = base_pose(body, body_from_camera)
    # Turn and place of the camera in its own axes, by those about the axes of the map.
    back, jacobian = camera.rotation.T, np.zeros((6, 6))
    jacobian[:3, 3:] = jacobian[3:, :3] = back
    spread = jacobian @ camera.covariance @ jacobian.T
    # Of numbers that are known to a metre and to a thousand kilometres rounding may leave none.
    scale = np.sqrt(spread.diagonal())
    values, vectors = np.linalg.eigh(spread / np.outer(scale, scale))
    whole = np.zeros((12, 12))
    whole[:6, :6] = np.outer(scale, scale) * ((vectors * np.maximum(values, _ROUNDING)) @ vectors.T)
    readout = config.readout_time
    for i, deviation in ((6, config.velocity_prior.angular), (9, config.velocity_prior.linear)):
        variance = (deviation * readout) ** 2 if deviation > 0.0 else np.inf
        whole[i : i + 3, i : i + 3][np.diag_indices(3)] = variance
    motion = Motion(back, -back @ camera.position, np.zeros(3), np.zeros(3))
    return Prior(motion=motion, covariance=whole)
