# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of poses and twists against the truth, row by row of the same times."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

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
