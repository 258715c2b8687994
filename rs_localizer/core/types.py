# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Types that pass between the stages and out of the library."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from numbers import Real
from typing import TYPE_CHECKING, Any, Literal, NoReturn, Self, TypeVar

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, Array1, Array2, BoolArray, real
from rs_localizer.core.shake import FUNCTIONS, shake_at, shake_basis, within_rows
from rs_localizer.core.shutter import Motion, carried, numbers_of
from rs_localizer.core.state import ANGULAR, LINEAR, MOTION_PARAMETERS, PARAMETERS, TURN
from rs_localizer.native import entry

if TYPE_CHECKING:  # kernels of other modules are compiled from this one, and not from words
    from rs_localizer.core.reasons import Reason

# Readouts within which accelerations fade by exp(-1): here they do not fade.
_NO_FADING = 1e9

# Row times at which the rate of the vibration is sampled.
_ROWS = np.linspace(-0.5, 0.5, 17)
_PARABOLAS = np.vander(_ROWS, 3) @ np.linalg.pinv(np.vander(_ROWS, 3))
# Pixels at the rim lie a little beyond the first and the last row.
_LAST_ROW = 0.55
# No lens moves a pixel by half an image; rows and seconds in place of row times are larger.
_FARTHEST = 1.0
# s: no motion goes on as it is for so long; more are milliseconds or nanoseconds.
_LONGEST_AWAY = 60.0


_Frozen = TypeVar("_Frozen")


def altered(one: _Frozen, **parts: Any) -> _Frozen:
    """Return a frozen dataclass with other parts, which are not checked.

    Takes a third of the time of ``dataclasses.replace``.
    """
    other, put = object.__new__(type(one)), object.__setattr__
    for name in vars(type(one))["__dataclass_fields__"]:
        put(other, name, parts[name] if name in parts else getattr(one, name))
    return other


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Estimate(Motion):
    """An accepted pose and velocity; true in a condition.

    ``covariance`` (12,12) is published. Its rows are a rotation vector in camera axes, the camera
    position in camera axes, angular velocity and linear velocity, in the units of the fields. It is
    marginal over accelerations and vibration. It includes errors of the calibration, which all
    frames share, and errors of this frame alone, such as hidden vibration.

    ``joint_covariance`` is what a tracker takes to the next frame. Its further rows are the
    accelerations (:mod:`rs_localizer.core.state`) and the coefficients of ``shake``. If
    ``refinement`` is ``none``, all covariances are NaN.
    """

    inliers: BoolArray  # (n,)
    residuals: Array  # (n,) px raw, reprojection errors, linear about the pixels; NaN: unusable
    joint_covariance: Array  # (18 + 3 k, 18 + 3 k)
    iterations: int  # minimal samples drawn
    # (12,12) part of ``covariance`` that errors of calibration and declared map cause
    calibration_covariance: Array = field(
        default_factory=np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS)).copy
    )
    # (12,12) part of ``covariance`` that vibration below the noise causes, and the curvature of
    # arcs about the scene on which the camera may lie
    undetected_covariance: Array = field(
        default_factory=np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS)).copy
    )
    # (12,12) part of ``covariance`` that a second, less probable explanation causes, as points with
    # a motion of their own: either they or all others lie elsewhere than the map says
    moved_covariance: Array = field(
        default_factory=np.zeros((MOTION_PARAMETERS, MOTION_PARAMETERS)).copy
    )
    still_deviation: float = math.inf  # rad, orientation_deviation if the motion were known
    # (k,3) rad: coefficients of the in-frame rotation, vibration (rs_localizer.core.shake)
    shake: Array = field(default_factory=np.zeros((0, 3)).copy)
    # (k,) log evidence of each size of vibration over none; empty: unknown
    vibrations: Array = field(default_factory=np.zeros(0).copy)
    model_error: float = 0.0  # px, rms error of map, lens and motion beside the noise
    declared_error: float = 0.0  # px, the part of it that map and calibration are declared to have
    tracked: bool = False  # found near a prior motion, without a search
    time_ns: int = 0  # of a tracker: when the middle row was exposed
    aided: bool = False  # more than the points tells of the rotation within the frame
    span: float = 0.0  # s, duration of one unit of row time; 0: unknown
    # Probability that the pose lies outside its region or the map is another one; NaN: not judged
    integrity: float = math.nan
    # False: the image does not tell rest from motion, and the velocities are a mean of both
    twist_known: bool = True
    left_out: str = ""  # what is odd about the points that are no inliers, one sentence

    @property
    def covariance(self) -> Array:
        """Covariance (12,12) of pose and velocities at tau = 0."""
        own = self.joint_covariance[:MOTION_PARAMETERS, :MOTION_PARAMETERS]
        frame = self.undetected_covariance + self.moved_covariance
        return own + self.calibration_covariance + frame

    def with_joint_covariance(self, joint_covariance: Array, **parts: Any) -> Self:
        """Return the estimate with a covariance that other frames have determined.

        Arcs may narrow the old covariance by its correlations, which the new one may lack. So only
        the positive part of ``undetected_covariance`` is kept.
        """
        variances = np.diag(self.joint_covariance)[:MOTION_PARAMETERS]
        known = (variances > 0.0) & (variances < np.inf)
        scale = np.sqrt(np.where(known, variances, 1.0))
        undetected = _widening(np.ascontiguousarray(self.undetected_covariance), scale)
        return altered(
            self, joint_covariance=joint_covariance, undetected_covariance=undetected, **parts
        )

    @property
    def orientation_deviation(self) -> float:
        """Standard deviation (rad) of the orientation at tau = 0, about the axis known worst.

        NaN where there is no covariance.
        """
        if np.isnan(self.joint_covariance[0, 0]):
            return math.nan
        return math.sqrt(np.linalg.eigvalsh(self.covariance[TURN, TURN])[-1])

    def shake_at(self, tau: float) -> tuple[Array, Array]:
        """Return the in-frame rotation (3,), rad, and its rate (3,), per readout, at ``tau``.

        No row shows the time before the first row or after the last one: there the rotation keeps
        the value of that row.
        """
        turn = shake_at(np.array([within_rows(tau)]), self.shake)[0]
        return turn[:3], turn[3:] if tau == within_rows(tau) else np.zeros(3)

    def turned_beside(self, tau: float) -> Array:
        """Return the rotation (3,3) by which the camera is turned beside that motion at ``tau``."""
        return so3.exp(-self.shake_at(tau)[0])

    def at(self, tau: float) -> tuple[Array, Array]:
        """Return the rotation (3,3) and translation (3,) camera_from_map at row time ``tau``.

        Raises:
            ValueError: beyond the rows; :meth:`at_time` goes on.
        """
        if not (isinstance(tau, Real) and abs(tau) <= _LAST_ROW):
            raise ValueError(
                f"tau must lie between -0.5, the first row, and 0.5, the last, got {tau!r}: it is "
                "a row time, neither seconds nor a row: camera.row_time(pixels) gives those of "
                "pixels, result.at_time(seconds) goes beyond the rows, at_rows takes several"
            )
        return self._at(float(tau))

    def _at(self, tau: float) -> tuple[Array, Array]:
        # By the class: super() fails in a dataclass with slots, and self.at is overridden.
        rotation, translation = Motion.at(self, tau)
        turned = self.turned_beside(tau)
        return turned @ rotation, turned @ translation

    def at_rows(self, tau: Array) -> tuple[Array, Array]:
        """Return the rotations (n,3,3) and translations (n,3) camera_from_map at row times (n,).

        Raises:
            ValueError: for what is no row time of a pixel in or near the image.
        """
        rotations, translations = Motion.at_rows(self, tau)
        if (farthest := np.abs(tau).max(initial=0.0)) > _FARTHEST:
            raise ValueError(
                f"tau must be row times, -0.5 of the first row and 0.5 of the last, got one of "
                f"{farthest:g}: camera.row_time(pixels) gives those of pixels"
            )
        if not len(self.shake):
            return rotations, translations
        turns = shake_at(np.clip(np.asarray(tau, float), -0.5, 0.5), self.shake)
        turned = so3.exp_many(-turns[:, :3])
        return turned @ rotations, np.einsum("nij,nj->ni", turned, translations)

    def angular_velocity_at(self, tau: float) -> Array:
        """Return the body rate (3,), rad per readout, in the camera axes at ``tau``."""
        turn, rate = self.shake_at(tau)
        body_rate = so3.exp(-turn) @ Motion.angular_velocity_at(self, tau)
        shaken: Array = body_rate + so3.right_jacobian(turn) @ rate
        return shaken

    def linear_velocity_at(self, tau: float) -> Array:
        """Return the velocity (3,) of the centre, m per readout, in the camera axes at ``tau``."""
        velocity = Motion.linear_velocity_at(self, tau)
        turned: Array = self.turned_beside(tau) @ velocity
        return turned

    def at_time(self, seconds: float) -> Estimate:
        """Return the motion this many seconds after its middle row, with its covariance then.

        Beyond the rows the acceleration is constant, and its uncertainty enters the covariance.

        Raises:
            ValueError: where the readout time is unknown.
        """
        real("seconds", seconds, "a finite number")
        if not self.span > 0.0:
            raise ValueError("the readout time is unknown, and so is the motion after the image")
        if abs(seconds) > _LONGEST_AWAY:
            raise ValueError(
                f"{seconds:g} s from the middle row is too far: the time is in seconds, and no "
                f"motion goes on for more than {_LONGEST_AWAY:g}"
            )
        moved = self.moved_to(float(seconds) / self.span)
        return altered(moved, time_ns=self.time_ns + round(1e9 * seconds))

    def moved_to(self, tau: float) -> Estimate:
        """Return the motion at a row time, also beyond the rows, with its covariance then.

        Vibration turns the camera beside its motion: its coefficients stand behind those of the
        motion in the covariance, and rotation and velocities then are linear in them.
        """
        later, motion = carried(numbers_of(self), tau, _NO_FADING)
        rotation, translation = Motion.at(self, tau)
        turn, rate = self.shake_at(tau)
        turned = so3.exp(-turn)  # camera axes at ``tau``
        angular = turned @ Motion.angular_velocity_at(self, tau) + so3.right_jacobian(turn) @ rate
        linear = turned @ Motion.linear_velocity_at(self, tau)
        own = (turned @ motion.reshape(-1, 3, PARAMETERS)).reshape(PARAMETERS, PARAMETERS)
        values, rates = np.zeros(FUNCTIONS), np.zeros(FUNCTIONS)
        shake_basis(within_rows(tau), values, rates)
        rates *= tau == within_rows(tau)
        shaken = (len(self.joint_covariance) - PARAMETERS) // 3
        by, unit, across = np.zeros((PARAMETERS, shaken, 3)), np.eye(3), so3.hat(linear)
        for part, change in ((TURN, unit), (ANGULAR, so3.hat(angular)), (LINEAR, across)):
            by[part] = values[:shaken, None] * change[:, None]
        by[ANGULAR] += rates[:shaken, None] * unit[:, None]
        transport = np.hstack([own, by.reshape(PARAMETERS, 3 * shaken)])
        shared = transport[:MOTION_PARAMETERS, :MOTION_PARAMETERS]
        joint = transport @ self.joint_covariance @ transport.T
        beyond, faster = beyond_rows(self, tau)
        joint[TURN, TURN] += beyond * unit
        joint[ANGULAR, ANGULAR] += faster * unit
        joint[LINEAR, LINEAR] += beyond * (across @ across.T)
        return altered(
            self, rotation=turned @ rotation, translation=turned @ translation,
            angular_velocity=angular, linear_velocity=linear,
            angular_acceleration=turned @ later[4], linear_acceleration=turned @ later[5],
            joint_covariance=joint,
            calibration_covariance=shared @ self.calibration_covariance @ shared.T,
            undetected_covariance=shared @ self.undetected_covariance @ shared.T,
            moved_covariance=shared @ self.moved_covariance @ shared.T,
            shake=np.zeros((0, 3)),
        )  # fmt: skip

    @property
    def position(self) -> Array:
        """Camera centre (3,) in the map frame at tau = 0."""
        centre: Array = -self.rotation.T @ self.translation
        return centre

    @property
    def residual_rms(self) -> float:
        """Root mean square reprojection error of the inliers, in pixels."""
        return float(np.sqrt(np.mean(self.residuals[self.inliers] ** 2)))

    def __bool__(self) -> Literal[True]:
        return True

    def __repr__(self) -> str:
        turn = np.degrees(np.linalg.norm(self.angular_velocity))
        return (
            f"Estimate(position={np.round(self.position, 4).tolist()}, "
            f"{np.count_nonzero(self.inliers)} of {len(self.inliers)} inliers at "
            f"{self.residual_rms:.3g} px rms, {turn:.3g} deg and "
            f"{np.linalg.norm(self.linear_velocity):.3g} m per readout)"
        )


@entry
def _widening(added: Array2, scale: Array1) -> Array:
    """Return the positive semidefinite part of a symmetric matrix (n,n) in units ``scale`` (n,)."""
    units = np.outer(scale, scale)
    values, vectors = np.linalg.eigh(added / units)
    part: Array = (vectors * np.maximum(values, 0.0)) @ vectors.T * units
    return part


def beyond_rows(estimate: Estimate, tau: float) -> tuple[float, float]:
    """Return variances of the rotation (rad^2) and its rate, per readout, outside of the rows.

    A camera that vibrates within the rows vibrates outside, too, in an unknown phase: it is assumed
    to rotate on at one of the rates that it had.
    """
    beyond = abs(tau - within_rows(tau))
    if beyond == 0.0:
        return 0.0, 0.0
    rates = shake_at(_ROWS, estimate.shake)[:, 3:]
    variance = float(np.mean(rates**2))
    return variance * beyond**2, variance


def roughness(estimate: Estimate) -> float:
    """Return the root mean square (rad per readout) of a vibration's rate beside a parabola."""
    rates = shake_at(_ROWS, estimate.shake)[:, 3:]
    return math.sqrt(float(np.mean((rates - _PARABOLAS @ rates) ** 2)))


@dataclass(frozen=True, slots=True)
class Failure:
    """No pose, and why; false in a condition."""

    reason: Reason
    detail: str  # one sentence with the figures

    def __bool__(self) -> Literal[False]:
        return False

    def __str__(self) -> str:
        return f"{self.reason}: {self.detail}"

    if not TYPE_CHECKING:  # a type checker knows the fields

        def __getattr__(self, name: str) -> NoReturn:
            if name.startswith("_") or name in ("reason", "detail"):
                raise AttributeError(name)
            raise AttributeError(
                f"there is no {name}, because there is no pose ({self}): test the result before, "
                "`if result:`"
            )
