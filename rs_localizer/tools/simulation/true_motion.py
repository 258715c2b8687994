# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""True motions of a simulated camera: constant velocity, or a spline through recorded poses.

A true motion knows its pose and its velocities at every instant; nothing of it is made of the
model that the estimators fit.
"""

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from scipy.interpolate import make_interp_spline, make_lsq_spline
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.trajectories import Trajectory, split_at_gaps

BODY_FROM_CAMERA = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
"""Camera axes (x right, y down, z forward) in those of REP-103's body, x forward and z up."""
# Motion capture at 100 Hz and more shakes by a few tenths of a degree from sample to sample: a
# spline through every sample turns that into accelerations that no hand has (0.24 degrees median,
# 8 at worst, off constant velocity in 30 ms on TUM VI room5; 0.04 and 0.27 with knots of 50 ms).
_KNOT_SPACING = 0.05
# Fewer samples to a knot than this leave nothing to average: then every sample is a knot.
_SAMPLES_PER_KNOT = 2.0
_DEGREE = 3


@dataclass(frozen=True, slots=True, eq=False)
class TrueState:
    """Camera poses and velocities at n instants."""

    rotations: Array  # (n,3,3) map_from_camera
    positions: Array  # (n,3) m, camera centre in the map
    angular: Array  # (n,3) rad/s, of the camera with respect to the map, camera axes
    linear: Array  # (n,3) m/s, of the camera centre with respect to the map, camera axes


class TrueMotion(Protocol):
    """Interface of a motion that is simulated."""

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        """First and last instant of each stretch without a gap, in the order of time."""

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        """Return the camera's state at ``stamp_ns`` plus ``offsets`` (n,) seconds."""


def sampled_states(motion: TrueMotion, spacing: float = 0.1) -> TrueState:
    """Return states at instants ``spacing`` seconds apart, all along a motion."""
    states = [
        motion.state(first, np.arange(0.0, max((last - first) * 1e-9, spacing), spacing))
        for first, last in motion.intervals_ns
    ]
    columns = ("rotations", "positions", "angular", "linear")
    return TrueState(*(np.concatenate([getattr(s, name) for s in states]) for name in columns))


@dataclass(frozen=True, slots=True, eq=False)
class ConstantVelocity:
    """A camera that turns at a constant body rate while its centre moves on a straight line.

    By default it starts at the origin, looks along the map's x axis, and z is up.
    """

    angular_velocity: Array  # (3,) rad/s in camera axes
    linear_velocity: Array  # (3,) m/s, along the camera's axes at the start
    duration: float  # s
    rotation: Array = field(  # map_from_camera at the start
        default_factory=BODY_FROM_CAMERA.copy
    )
    position: Array = field(default_factory=lambda: np.zeros(3))
    start_ns: int = 0

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return [(self.start_ns, self.start_ns + round(self.duration * 1e9))]

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        t = (stamp_ns - self.start_ns) * 1e-9 + np.asarray(offsets, float)
        rotations = self.rotation @ so3.exp_many(t[:, None] * self.angular_velocity)
        velocity = self.rotation @ self.linear_velocity
        return TrueState(
            rotations,
            self.position + t[:, None] * velocity,
            np.broadcast_to(np.asarray(self.angular_velocity, float), (len(t), 3)),
            velocity @ rotations,
        )


class RecordedMotion:
    """Cubic splines through recorded poses, one for each stretch without a gap.

    The truth is the spline itself, with its exact derivatives; the samples only shape it.

    Args:
        trajectory: map_from_body, of REP-103's body.

    Raises:
        ValueError: when no stretch is long enough for a spline.
    """

    def __init__(self, trajectory: Trajectory) -> None:
        spacings = np.diff(trajectory.stamps_ns) * 1e-9
        coarse = _SAMPLES_PER_KNOT * (np.median(spacings) if len(spacings) else 0.0) > _KNOT_SPACING
        self._stretches = [
            _Stretch(part, 0.0 if coarse else _KNOT_SPACING)
            for part in split_at_gaps(trajectory)
            if len(part) > _DEGREE + 1
        ]
        if not self._stretches:
            raise ValueError(
                f"a trajectory needs a stretch of more than {_DEGREE + 1} poses without a gap; "
                f"this one has {len(trajectory)} poses"
            )

    @property
    def intervals_ns(self) -> list[tuple[int, int]]:
        return [(stretch.start_ns, stretch.end_ns) for stretch in self._stretches]

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        starts = [stretch.start_ns for stretch in self._stretches]
        index = max(int(np.searchsorted(starts, stamp_ns, side="right")) - 1, 0)
        return self._stretches[index].state(stamp_ns, offsets)


class _Stretch:
    """One spline in seven columns: position and a quaternion that is normalized afterwards."""

    def __init__(self, part: Trajectory, knot_spacing: float) -> None:
        self.start_ns, self.end_ns = part.stamps_ns[[0, -1]].tolist()
        t = np.asarray((part.stamps_ns - self.start_ns) * 1e-9, np.float64)
        q = part.quaternions  # without jumps between q and -q
        flips = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0.0, -1.0, 1.0)
        values = np.hstack([part.positions, q * np.cumprod(np.r_[1.0, flips])[:, None]])
        self._spline = _spline(t, values, knot_spacing)
        self._rate = self._spline.derivative()

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        t = (stamp_ns - self.start_ns) * 1e-9 + np.asarray(offsets, float)
        values, rates = self._spline(t), self._rate(t)
        norms = np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        q, q_rate = values[:, 3:] / norms, rates[:, 3:] / norms
        rotations = Rotation.from_quat(q).as_matrix() @ BODY_FROM_CAMERA
        # Body rate: the vector part of 2 conj(q) dq/dt; a change of the norm has none.
        body_rate = 2.0 * (
            q[:, 3:] * q_rate[:, :3] - q_rate[:, 3:] * q[:, :3] - np.cross(q[:, :3], q_rate[:, :3])
        )
        return TrueState(
            rotations, values[:, :3], body_rate @ BODY_FROM_CAMERA,
            np.einsum("nji,nj->ni", rotations, rates[:, :3]),
        )  # fmt: skip


def _spline(t: Array, values: Array, knot_spacing: float) -> Any:
    intervals = int(t[-1] / knot_spacing) if knot_spacing > 0.0 else 0
    if intervals < 1:
        return make_interp_spline(t, values, k=_DEGREE)
    inner = np.linspace(0.0, t[-1], intervals + 1)
    knots = np.concatenate([[0.0] * _DEGREE, inner, [t[-1]] * _DEGREE])
    return make_lsq_spline(t, values, knots, k=_DEGREE)
