# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How far estimates are from the truth: errors, and the frame and the clock to compare them in.

Alignment: two trajectories in frames of their own, laid over each other by positions and
orientations. Time offset: how fast a body turns is the same in every frame, so its angular speed
over time is a signature: the shift at which both signatures correlate best is the offset, to a few
milliseconds, however far apart the clocks are. Around it, the poses themselves say it more exactly,
as far as they are given in the same frame.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar
from scipy.signal import correlate, correlation_lags
from scipy.spatial.transform import Rotation, Slerp

from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import Trajectory, Twists

Stamps = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Summary:
    """What a list of errors comes to; NaN for an empty one."""

    count: int
    median: float
    mean: float
    p95: float
    maximum: float


def summarize(errors: Array) -> Summary:
    """Summary of errors (n,)."""
    if len(errors) == 0:
        return Summary(0, np.nan, np.nan, np.nan, np.nan)
    return Summary(
        len(errors),
        float(np.median(errors)),
        float(np.mean(errors)),
        float(np.percentile(errors, 95)),
        float(np.max(errors)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Errors:
    """Errors of n poses or twists at the times of their estimates."""

    stamps_ns: Stamps  # (n,)
    linear: Array  # (n,) m or m/s
    angular: Array  # (n,) deg or deg/s
    true_angular_rate: Array  # (n,) deg/s; NaN where the truth is a pose alone


def associate(
    estimated: Stamps, true: Stamps, tolerance_ns: int
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of rows whose times differ by no more than the tolerance.

    Args:
        estimated: (n,) ns.
        true: (m,) ns, increasing.

    Returns:
        rows of ``estimated`` and, for each, the row of ``true`` that is nearest in time.
    """
    if len(true) == 0:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    after = np.clip(np.searchsorted(true, estimated), 1, max(len(true) - 1, 1))
    before = after - 1
    after = np.minimum(after, len(true) - 1)
    nearer = np.abs(true[after] - estimated) < np.abs(estimated - true[before])
    nearest = np.where(nearer, after, before)
    rows = np.flatnonzero(np.abs(true[nearest] - estimated) <= tolerance_ns)
    return rows, nearest[rows]


def pose_errors(estimated: Trajectory, true: Trajectory, tolerance_ns: int = 0) -> Errors:
    """Distance of the positions (m) and angle between the orientations (deg)."""
    rows, true_rows = associate(estimated.stamps_ns, true.stamps_ns, tolerance_ns)
    estimate, truth = estimated.part(rows), true.part(true_rows)
    return Errors(
        estimate.stamps_ns,
        np.linalg.norm(estimate.positions - truth.positions, axis=1),
        angles_between(estimate.quaternions, truth.quaternions),
        np.full(len(rows), np.nan),
    )


def twist_errors(estimated: Twists, true: Twists, tolerance_ns: int = 0) -> Errors:
    """Length of the differences of the linear (m/s) and the angular (deg/s) velocities."""
    rows, true_rows = associate(estimated.stamps_ns, true.stamps_ns, tolerance_ns)
    estimate, truth = estimated.part(rows), true.part(true_rows)
    return Errors(
        estimate.stamps_ns,
        np.linalg.norm(estimate.linear - truth.linear, axis=1),
        np.degrees(np.linalg.norm(estimate.angular - truth.angular, axis=1)),
        np.degrees(np.linalg.norm(truth.angular, axis=1)),
    )


def angles_between(quaternions: Array, others: Array) -> Array:
    """Angles (n,) in degrees between rotations given as quaternions (n,4), x y z w."""
    if len(quaternions) == 0:
        return np.zeros(0)
    between = Rotation.from_quat(quaternions).inv() * Rotation.from_quat(others)
    return np.degrees(np.asarray(between.magnitude(), np.float64))


# Positions say nothing of the rotation where the camera stays within this (m).
_LEAST_SPREAD = 1e-3


def aligned(estimate: Trajectory, truth: Trajectory) -> Trajectory:
    """The estimate in the frame of the truth: rigidly moved to fit row by row.

    Positions alone (Umeyama, 1991) leave the rotation undetermined along a straight path, and
    orientations are wrong by what it takes then. Here both count, each by how well it fits:
    ``sum |R q_i p_i^-1|^2 / s_q^2 + sum |R (x_i - m_x) - (y_i - m_y)|^2 / s_x^2``, two steps.
    """
    estimated, true = (Rotation.from_quat(part.quaternions) for part in (estimate, truth))
    between = true * estimated.inv()
    turn = between.mean()
    x = estimate.positions - estimate.positions.mean(axis=0)
    y = truth.positions - truth.positions.mean(axis=0)
    spread = float(np.sqrt(np.mean(np.sum(x**2, axis=1))))
    if spread > _LEAST_SPREAD:
        for _ in range(2):
            angles = np.asarray((turn.inv() * between).magnitude())
            angle_squared = max(float(np.mean(angles**2)), 1e-12)
            off_squared = max(float(np.mean(np.sum((turn.apply(x) - y) ** 2, axis=1))), 1e-12)
            # Both terms are linear in R, so that their sum is a problem of Procrustes; a rotation
            # that is off by a adds 2 - 2 cos(a) times the weight, in two of three axes.
            matrix = np.einsum("nij->ij", between.as_matrix()) / (2.0 * angle_squared)
            matrix = matrix + (y.T @ x) / off_squared
            u, _, vt = np.linalg.svd(matrix)
            turn = Rotation.from_matrix(u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt)
    positions = turn.apply(x) + truth.positions.mean(axis=0)
    return Trajectory(estimate.stamps_ns, positions, np.asarray((turn * estimated).as_quat()))


_STEP = 0.01  # s, of the signatures
# Shorter spacings (s) make noise of rounding errors; longer ones, in medians, are gaps.
_LEAST_SPACING, _GAP = 1e-3, 4.0
# An overlap of less than this (s, and share of the shorter one) may fit by chance.
_LEAST_OVERLAP, _OVERLAP_SHARE = 1.0, 0.3
_LEAST_CORRELATION = 0.6
_MOST_SAMPLES = 2_000_000  # 5.5 h
# The poses are compared at this many shifts within this reach (s), then in between.
_REACH, _SHIFTS = 0.06, 25
# Orientations that are off by this multiple of what they are off by once laid over each other are
# those of another frame.
_OTHER_FRAME = 5.0
# Errors this many times the median count no more.
_LARGEST = 3.0


@dataclass(frozen=True, slots=True)
class TimeOffset:
    """What has to be added to the times of the one to have those of the other."""

    seconds: float
    correlation: float  # of the angular speeds, at most 1
    before: float  # deg, median orientation error with the times as they are; NaN: no overlap
    after: float  # deg, with the offset


def estimate_offset(estimate: Trajectory, truth: Trajectory) -> TimeOffset | None:
    """Offset to add to the times of ``estimate``; None where the motion does not tell."""
    first, second = _signature(estimate), _signature(truth)
    if first is None or second is None:
        return None
    best = _best_lag(first, second)
    if best is None:
        return None
    lag, correlation = best
    origin = (int(truth.stamps_ns[0]) - int(estimate.stamps_ns[0])) * 1e-9
    seconds = origin + lag * _STEP
    for _ in range(2):  # what is laid over each other at a wrong time is a bit off
        seconds = _refined(_in_frame(estimate, truth, seconds), truth, seconds)
    before, after = (_median_turn(estimate, truth, shift) for shift in (0.0, seconds))
    return TimeOffset(seconds, correlation, before, after)


def shifted(trajectory: Trajectory, seconds: float) -> Trajectory:
    """The same poses at other times."""
    stamps = trajectory.stamps_ns + round(seconds * 1e9)
    return Trajectory(stamps, trajectory.positions, trajectory.quaternions)


def interpolated(trajectory: Trajectory, stamps_ns: Stamps) -> tuple[NDArray[np.bool_], Trajectory]:
    """Poses at other times; which of these (n,) lie between poses that follow each other closely.

    Positions run straight and orientations at a constant rate in between.
    """
    inside = _between(trajectory.stamps_ns, stamps_ns)
    if not inside.any():
        return inside, trajectory.part(slice(0, 0))
    times = stamps_ns[inside]
    seconds, wanted = _seconds(trajectory.stamps_ns, times)
    turns = Slerp(seconds, Rotation.from_quat(trajectory.quaternions))(wanted)
    positions = _columns(wanted, seconds, trajectory.positions)
    return inside, Trajectory(times, positions, np.asarray(turns.as_quat()))


def interpolated_twists(twists: Twists, stamps_ns: Stamps) -> Twists:
    """Velocities at other times, as far as they lie between some that follow closely."""
    times = stamps_ns[_between(twists.stamps_ns, stamps_ns)]
    seconds, wanted = _seconds(twists.stamps_ns, times)
    angular, linear = (_columns(wanted, seconds, v) for v in (twists.angular, twists.linear))
    return Twists(times, angular, linear)


def _between(own: Stamps, wanted: Stamps) -> NDArray[np.bool_]:
    if len(own) < 2:
        return np.zeros(len(wanted), bool)
    after = np.clip(np.searchsorted(own, wanted), 1, len(own) - 1)
    close = own[after] - own[after - 1] <= _GAP * np.median(np.diff(own))
    return np.asarray((wanted >= own[0]) & (wanted <= own[-1]) & close)


def _seconds(own: Stamps, wanted: Stamps) -> tuple[Array, Array]:
    return (own - own[0]) * 1e-9, (wanted - own[0]) * 1e-9


def _columns(wanted: Array, seconds: Array, values: Array) -> Array:
    return np.column_stack([np.interp(wanted, seconds, column) for column in values.T])


def _signature(trajectory: Trajectory) -> tuple[Array, Array] | None:
    """Angular speed on an even grid from the first pose on, and where it is known (1 or 0)."""
    seconds = (trajectory.stamps_ns - trajectory.stamps_ns[0]) * 1e-9
    keep = np.concatenate([[True], np.diff(seconds) > _LEAST_SPACING])
    seconds, quaternions = seconds[keep], trajectory.quaternions[keep]
    count = int(seconds[-1] / _STEP) + 1
    if len(seconds) < 10 or count > _MOST_SAMPLES:
        return None
    turns = Rotation.from_quat(quaternions)
    spacing = np.diff(seconds)
    speeds = np.asarray((turns[:-1].inv() * turns[1:]).magnitude()) / spacing
    grid = _STEP * np.arange(count)
    known = spacing[np.clip(np.searchsorted(seconds, grid) - 1, 0, len(spacing) - 1)]
    there = (known <= _GAP * np.median(spacing)).astype(np.float64)
    return np.interp(grid, seconds[:-1] + 0.5 * spacing, speeds) * there, there


def _best_lag(
    first: tuple[Array, Array], second: tuple[Array, Array]
) -> tuple[float, float] | None:
    """Steps by which the first signature has to move, and the correlation there."""
    (a, a_known), (b, b_known) = first, second

    def sums(x: Array, y: Array) -> Array:
        return np.asarray(correlate(y, x, mode="full", method="fft"))

    count = sums(a_known, b_known)
    least = max(_LEAST_OVERLAP / _STEP, _OVERLAP_SHARE * min(a_known.sum(), b_known.sum()))
    enough = count >= least
    if not enough.any():
        return None
    count = np.maximum(count, 1.0)
    mean_a, mean_b = sums(a, b_known) / count, sums(a_known, b) / count
    covariance = sums(a, b) / count - mean_a * mean_b
    spread = (sums(a**2, b_known) / count - mean_a**2) * (sums(a_known, b**2) / count - mean_b**2)
    scale = float(np.var(a) * np.var(b))
    fit = np.where(enough & (spread > 1e-6 * scale), covariance, 0.0)
    fit /= np.sqrt(np.maximum(spread, 1e-6 * scale + 1e-300))
    best = int(np.argmax(fit))
    if not fit[best] >= _LEAST_CORRELATION:
        return None
    return float(correlation_lags(len(b), len(a))[best]), float(fit[best])


def _in_frame(estimate: Trajectory, truth: Trajectory, seconds: float) -> Trajectory:
    """The estimate, in the frame of the truth if it is given in another one."""
    moved = shifted(estimate, seconds)
    inside, true = interpolated(truth, moved.stamps_ns)
    if np.count_nonzero(inside) < 10:
        return estimate
    part = moved.part(inside)
    laid = aligned(part, true)
    as_it_is, after = (float(np.median(pose_errors(p, true).angular)) for p in (part, laid))
    if as_it_is < _OTHER_FRAME * max(after, 0.1):
        return estimate
    turn = Rotation.from_quat(laid.quaternions[0]) * Rotation.from_quat(part.quaternions[0]).inv()
    shift = laid.positions[0] - turn.apply(part.positions[0])
    quaternions = (turn * Rotation.from_quat(estimate.quaternions)).as_quat()
    positions = turn.apply(estimate.positions) + shift
    return Trajectory(estimate.stamps_ns, positions, np.asarray(quaternions))


def _refined(estimate: Trajectory, truth: Trajectory, seconds: float) -> float:
    """The shift nearby at which the poses fit best; as given where they fit nowhere."""
    # Counted from there: beside 1.7e9 s, a search would not see milliseconds.
    shifts = np.linspace(-_REACH, _REACH, _SHIFTS)
    middle = _errors(estimate, truth, seconds)
    if middle is None:
        return seconds
    scales = [max(float(np.median(part)), 1e-9) for part in middle]

    def cost(shift: float) -> float:
        parts = _errors(estimate, truth, seconds + shift)
        if parts is None:
            return np.inf
        return sum(
            float(np.mean(np.minimum(part / scale, _LARGEST)))
            for part, scale in zip(parts, scales, strict=True)
        )

    costs = [cost(shift) for shift in shifts]
    best = int(np.argmin(costs))
    if not 0 < best < _SHIFTS - 1:
        return seconds
    bounds = (float(shifts[best - 1]), float(shifts[best + 1]))
    minimum = minimize_scalar(cost, bounds=bounds, method="bounded", options={"xatol": 1e-5})
    # Of exact poses, the cost has a narrow dip that a search may miss.
    return seconds + float(minimum.x if minimum.fun < costs[best] else shifts[best])


def _errors(estimate: Trajectory, truth: Trajectory, shift: float) -> tuple[Array, Array] | None:
    """Distances (m) and angles (deg); None where too little overlaps."""
    moved = shifted(estimate, shift)
    inside, true = interpolated(truth, moved.stamps_ns)
    if np.count_nonzero(inside) < max(10, _OVERLAP_SHARE * len(estimate)):
        return None
    errors = pose_errors(moved.part(inside), true)
    return errors.linear, errors.angular


def _median_turn(estimate: Trajectory, truth: Trajectory, shift: float) -> float:
    errors = _errors(estimate, truth, shift)
    return np.nan if errors is None else float(np.median(errors[1]))
