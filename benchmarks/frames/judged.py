# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Conditions through the public interfaces of the package, and the figures of each."""

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2, norm

import rs_localizer as rsl
from benchmarks.frames.conditions import EXACT, Condition
from benchmarks.frames.generated import Frame, Gyroscope, calibrated, generate
from benchmarks.independent.rotations import Array, logarithm
from rs_localizer.config import CalibrationErrors
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.solvers.table import find_solver

REGION = float(chi2.ppf(0.95, 6))
# As unlikely as five standard deviations are of one variable (6 in 10 million).
FIVE_SIGMA = float(chi2.isf(2.0 * norm.sf(5.0), 6))
_MEDIAN = float(chi2.median(3))
# The errors of a calibration point there, by turns.
_DIRECTIONS = np.array([(0.6, 0.8), (-0.8, 0.6), (-0.6, -0.8), (0.8, -0.6)])

FIGURES = (
    "recording", "ms",
    # Squared normalized errors, of 6 and of 3 dimensions; at the stamp (s) and at mid-frame.
    "pose_s", "pose", "twist", "turn_s", "turn", "way", "angular", "linear",
    "deg_s", "deg", "mm", "deg/s", "m/s",
)  # fmt: skip
"""Of a frame; NaN without a pose, or where a camera has no velocities."""


@dataclass(frozen=True, eq=False)
class Judged:
    """The frames of a condition that count."""

    figures: Array  # (n, len(FIGURES))
    reasons: list[str]  # (n,) why there is no pose; empty: there is one

    def of(self, name: str) -> Array:
        return np.asarray(self.figures[:, FIGURES.index(name)])

    @property
    def localized(self) -> NDArray[np.bool_]:
        return np.array([not reason for reason in self.reasons])

    def inside(self, name: str) -> NDArray[np.bool_]:
        """Of the localized frames (k,), which truths lie in a 95 % region: pose_s, pose, twist."""
        held: NDArray[np.bool_] = self.of(name)[self.localized] < REGION
        return held


def quantile(values: Array, q: float) -> float:
    """Of the known ones; NaN of none."""
    known = values[~np.isnan(values)]
    return float(np.quantile(known, q)) if len(known) else math.nan


def sharpness(squared: Array) -> float:
    """Claimed over actual deviation, from squared normalized errors of three dimensions."""
    median = quantile(squared, 0.5)
    return math.sqrt(_MEDIAN / median) if median > 0.0 else math.nan


def far_off(judged: Judged) -> NDArray[np.bool_]:
    """Frames (n,) whose pose at one of the moments is beyond five standard deviations."""
    localized = judged.localized
    beyond: NDArray[np.bool_] = localized & ~(
        (judged.of("pose_s") < FIVE_SIGMA) & (judged.of("pose") < FIVE_SIGMA)
    )
    return beyond


def judge(condition: Condition, frames: int, seed: int, settings: Mapping[str, Any]) -> Judged:
    """All frames of a condition, in their order."""
    own = dict(condition.settings) | dict(settings)
    # As users are told: the final inliers may miss by twice the threshold, 3.5 deviations have to.
    own.setdefault("inlier_threshold", max(2.0, 2.0 * condition.noise))
    # Keypoints that are off together are like a principal point that is off.
    together = condition.points.shift or any(condition.points.alike)
    if condition.calibration == EXACT and not together:
        own.setdefault("calibration", CalibrationErrors(0.0, 0.0, 0.0, 0.0))
    config = rsl.LocalizerConfig(**own)
    variants = 1 if condition.calibration == EXACT else len(_DIRECTIONS)
    localizers = [rsl.Localizer(camera_of(condition, k), config) for k in range(variants)]
    # A global shutter has no velocities, and is not tracked.
    tracks = condition.sequence.length > 1 and find_solver(config.solver).rolling_shutter
    trackers = [rsl.Tracker(one) for one in localizers] if tracks else None
    figures: list[list[float]] = []
    reasons: list[str] = []
    for frame in generate(condition, frames, seed):
        variant = frame.recording % variants
        localize: Any
        first: tuple[int, ...]
        if trackers is None:
            localize, first = localizers[variant].localize, ()
        else:
            if frame.place == 0:
                trackers[variant].reset()
            localize, first = trackers[variant].localize, (frame.middle_ns,)
        readout = localizers[variant].camera.readout_time
        known: dict[str, Any] = (
            {} if frame.gyroscope is None else {"rotation": _rotation(frame.gyroscope, readout)}
        )
        start = time.process_time()
        try:
            result = localize(*first, frame.points, frame.pixels, **known)
            reason = "" if result else str(result.reason)
        except (ArithmeticError, ValueError) as error:
            result, reason = None, f"crashed_{type(error).__name__}"
        taken = 1e3 * (time.process_time() - start)
        if frame.counts:
            reasons.append(reason)
            scored = _scored(result, frame, condition) if result else [math.nan] * 13
            figures.append([frame.recording, taken, *scored])
    return Judged(np.array(figures), reasons)


def camera_of(condition: Condition, variant: int) -> rsl.Camera:
    """What the user believes of the camera."""
    true, off = condition.camera, condition.calibration
    direction = _DIRECTIONS[variant]
    if off.boards:
        matrix, distortion = calibrated(true, off.boards, variant)
    else:
        matrix, distortion = true.matrix, (1.0 - off.distortion) * np.array(true.distortion)
    matrix[:2, 2] += off.centre * direction
    matrix[[0, 1], [0, 1]] *= 1.0 + off.focal * math.copysign(1.0, direction[0])
    readout_time = true.readout_time if off.readout_time is None else off.readout_time
    return rsl.Camera(
        true.width, true.height, matrix, distortion, readout_time=readout_time,
        scan_direction=str(off.scan or true.scan),
    )  # fmt: skip


# ns; and a delay (s), scales and a mount (rad) that are known.
_MIDDLE_NS, _EXACT = 10**12, 1e-6


def _rotation(gyroscope: Gyroscope, readout: float) -> Any:
    from rs_localizer.inertial.gyro_prior import rotation_by
    from rs_localizer.inertial.samples import ImuSamples
    from rs_localizer.inertial.turning import GyroscopeErrors, read

    stamps = _MIDDLE_NS + np.rint(1e9 * readout * gyroscope.tau).astype(np.int64)
    period = readout * float(np.mean(np.diff(gyroscope.tau)))
    known = np.diag(np.repeat([gyroscope.bias_deviation, *3 * [_EXACT]], [3, 1, 3, 3]) ** 2)
    errors = GyroscopeErrors(np.zeros(10), known, gyroscope.rate_deviation * math.sqrt(period))
    found = read(ImuSamples(stamps, gyroscope.rates), _MIDDLE_NS, readout, errors)
    assert found is not None
    return rotation_by(found, errors)


def _scored(result: Any, frame: Frame, condition: Condition) -> list[float]:
    """Behind recording and time, in the order of FIGURES."""
    believed = condition.calibration.readout_time
    readout = condition.camera.readout_time if believed is None else believed
    pose_s, turn_s, _, deg_s, _ = of_pose(pose_at(result, -0.5), frame.stamp)
    pose, turn, way, deg, mm = of_pose(pose_at(result, 0.0), frame.middle)
    twist = [math.nan] * 5
    if condition.camera.readout_time > 0.0 and readout > 0.0:
        twist = of_twist(twist_at(result, 0.0, readout), frame.middle)
    return [pose_s, pose, twist[0], turn_s, turn, way, *twist[1:3], deg_s, deg, mm, *twist[3:]]


def of_pose(pose: Any, truth: tuple[Array, ...]) -> tuple[float, ...]:
    """Squared normalized errors of 6, 3 and 3 dimensions; deg and mm."""
    turn = logarithm(truth[0] @ pose.rotation.T)  # in the axes of the map, as the covariance
    way = truth[1] - pose.position
    return (
        *_normalized_parts(way, turn, pose.covariance), math.degrees(np.linalg.norm(turn)),
        1e3 * float(np.linalg.norm(way)),
    )  # fmt: skip


def of_twist(twist: Any, truth: tuple[Array, ...]) -> list[float]:
    """Squared normalized errors of 6, 3 and 3 dimensions; deg/s and m/s."""
    angular, linear = truth[2] - twist.angular, truth[3] - twist.linear
    parts = _normalized_parts(linear, angular, twist.covariance)
    return [*parts, math.degrees(np.linalg.norm(angular)), float(np.linalg.norm(linear))]


def _normalized_parts(way: Array, turn: Array, covariance: Array) -> tuple[float, ...]:
    return (
        normalized(np.concatenate([way, turn]), covariance), normalized(turn, covariance[3:, 3:]),
        normalized(way, covariance[:3, :3]),
    )  # fmt: skip


def normalized(error: Array, covariance: Array) -> float:
    """Squared Mahalanobis length; infinite where a covariance denies that there is an error."""
    if not np.any(error):
        return 0.0
    deviations = np.sqrt(np.diag(covariance))
    if not np.all(deviations > 0.0):
        return math.inf
    try:
        # Metres and radians differ by far: scaled, rounding does not decide.
        factor = np.linalg.cholesky(covariance / np.outer(deviations, deviations))
    except np.linalg.LinAlgError:
        return math.inf
    return float(np.sum(np.linalg.solve(factor, error / deviations) ** 2))
