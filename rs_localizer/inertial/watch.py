# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether a gyroscope can be believed, by what the camera sees.

Whether another rotation camera <- imu would make gyroscope and camera agree.

The rotation that carries the gyroscope's turns into the camera's (Wahba, "A least squares estimate
of satellite attitude", 1965; by the singular values of their correlation: Markley, 1988).

The time offset of a gyroscope from turns of the camera between frames.

Each pair of frames has a turn; at the right offset, and less its bias, the gyroscope turned as much
meanwhile. A vibration makes the error a wave of the offset, so it is searched for on a grid, and
the bias is the best at each point of it (variable projection). The curvature at the minimum tells
how well the offset is known.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.rate_spline import rotations_at_knots, spline, turns_at
from rs_localizer.core.simd.jit import kernel
from rs_localizer.core.so3 import log
from rs_localizer.estimation.refine import inverted
from rs_localizer.inertial.filter import GyroscopeFilter
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.turning import turn_between


class Alone(StrEnum):
    """Why the camera goes without its gyroscope."""

    NONE = "none"  # it does not
    NO_SAMPLES = "no_samples"
    NOT_COVERED = "not_covered"  # not the whole exposure
    DOUBTED = "doubted"  # in this frame the points fit better without it
    DISAGREES = "disagrees"  # in many frames, and no other time offset or mounting explains it
    TURNED = "turned"  # in many frames, as if camera_from_imu were turned


@dataclass(frozen=True, slots=True, eq=False)
class InertialStatus:
    """The gyroscope after a frame; what is not known is NaN."""

    alone: Alone
    bias: Array = field(default_factory=lambda: np.full(3, math.nan))  # (3,) rad/s, camera axes
    bias_deviation: float = math.nan  # rad/s, of an axis
    time_offset: float = math.nan  # s, to be added to the times of the samples
    time_offset_deviation: float = math.nan  # s
    extrinsic_angle: float = 0.0  # rad by which camera_from_imu seems to be turned

    @property
    def used(self) -> bool:
        return self.alone is Alone.NONE


# Offsets to try, s; finer than a tenth of the cycle of what can shake a camera at 100 Hz.
_FARTHEST, _STEP = 0.06, 0.001
# Squared errors per degree of freedom of turns that agree; covariances are a little off.
_AGREE = 4.0
_FEWEST = 12  # pairs
_LEAST_DEVIATION = 1e-5  # s


@dataclass(frozen=True, slots=True, eq=False)
class CameraTurn:
    """The turn of the camera between two frames."""

    from_ns: int
    to_ns: int
    rotation: Array  # (3,3) camera_then_from_camera_now
    deviation: float  # rad, of each axis


@dataclass(frozen=True, slots=True)
class OffsetFit:
    """The best offset."""

    time_offset: float  # s, to be added to the times of the samples
    deviation: float  # s
    misfit: float  # squared errors per degree of freedom
    at_rest: float  # the same for a gyroscope that shows nothing

    @property
    def explains(self) -> bool:
        """Whether the gyroscope agrees with the camera at this offset, and it moved enough."""
        return self.misfit < min(_AGREE, 0.1 * self.at_rest)


def fit_offset(times_ns: IntArray, rates: Array, turns: Sequence[CameraTurn]) -> OffsetFit | None:
    """The offset at which a gyroscope agrees best with the turns of a camera.

    Args:
        times_ns: (n,) of the samples.
        rates: (n,3) rad/s, camera axes.
        turns: of the camera; those that the samples do not cover at all offsets do not count.

    Returns:
        None if too few count.
    """
    reach = round(1e9 * _FARTHEST)
    covered = [
        turn
        for turn in turns
        if turn.from_ns - reach > times_ns[0] and turn.to_ns + reach < times_ns[-1]
    ]
    if len(covered) < _FEWEST:
        return None
    origin = int(times_ns[0])
    times = np.asarray(1e-9 * (times_ns - origin), np.float64)
    cubics = spline(times, np.ascontiguousarray(rates))
    knots = rotations_at_knots(times, cubics)
    start = 1e-9 * np.array([turn.from_ns - origin for turn in covered])
    end = 1e-9 * np.array([turn.to_ns - origin for turn in covered])
    seen = np.array([turn.rotation for turn in covered])
    weight = 1.0 / np.array([turn.deviation for turn in covered])

    def errors(offset: float) -> Array:
        before, _ = turns_at(start - offset, times, cubics, knots)
        after, _ = turns_at(end - offset, times, cubics, knots)
        shown = after @ np.swapaxes(before, 1, 2)
        # What the camera turned more than the gyroscope showed, in the axes of then: -dt b.
        return _logs(shown @ np.swapaxes(seen, 1, 2))

    def misfit(offset: float) -> float:
        error, along = errors(offset) * weight[:, None], -(end - start) * weight
        bias = along @ error / (along @ along)
        return float(np.sum((error - along[:, None] * bias) ** 2))

    grid = np.arange(-_FARTHEST, _FARTHEST + 0.5 * _STEP, _STEP)
    costs = np.array([misfit(offset) for offset in grid])
    best = int(np.clip(np.argmin(costs), 1, len(grid) - 2))
    step = _STEP
    offset, low, middle, high = grid[best], *costs[best - 1 : best + 2]
    for _ in range(3):  # parabolas through three points, closer and closer
        bend = low - 2.0 * middle + high
        if not bend > 0.0:
            return None
        offset += float(np.clip(0.5 * step * (low - high) / bend, -step, step))
        curvature = bend / step**2
        step *= 0.25
        low, middle, high = (misfit(offset + shift) for shift in (-step, 0.0, step))
    freedom = 3 * len(covered) - 4
    per_freedom = middle / freedom
    turned = np.einsum("n,ni->", weight**2, _logs(seen) ** 2)
    return OffsetFit(
        float(offset),
        max(math.sqrt(2.0 * max(per_freedom, 1.0) / curvature), _LEAST_DEVIATION),
        per_freedom,
        float(turned) / freedom,
    )


def _logs(rotations: Array) -> Array:
    return np.array([log(np.ascontiguousarray(rotation)) for rotation in rotations])


# Turns that a rotation explains, as a part of their sum of squares that it leaves.
_EXPLAINED = 0.1
# Turns about one axis alone say nothing of the others: second singular value to the first.
_LEAST_SPREAD = 0.02


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """A rotation between the axes of the samples and those of the camera."""

    rotation: Array  # (3,3) camera_from_samples; the identity if TF is right
    left: float  # part of the squared turns that it does not explain

    @property
    def angle(self) -> float:
        """rad."""
        return float(np.linalg.norm(so3.log(self.rotation)))

    @property
    def explains(self) -> bool:
        return self.left < _EXPLAINED


def fit_mounting(shown: Array, seen: Array) -> Mounting | None:
    """The rotation that fits turns of the gyroscope (n,3) to those of the camera (n,3), both rad.

    None where they do not tell it.
    """
    left, sizes, right = np.linalg.svd(seen.T @ shown)
    if not sizes[1] > _LEAST_SPREAD * sizes[0]:
        return None
    sign = np.sign(np.linalg.det(left @ right))
    rotation = np.ascontiguousarray(left * [1.0, 1.0, sign] @ right)
    return Mounting(rotation, float(np.sum((seen - shown @ rotation.T) ** 2) / np.sum(seen**2)))


# Squared Mahalanobis length of what a frame changes in the predicted rotation and turn rate; a
# chi-squared variable of six degrees of freedom exceeds this once in a million.
_MOST_SURPRISE = 38.0
# So many of the last frames that contradict the gyroscope are no chance.
_WATCHED, _CONTRADICTIONS = 12, 6
# Turns of the camera that are kept to find out why, and how often that is tried (frames).
_KEPT, _TRY_EVERY = 90, 15
_LONGEST_PAIR_NS = 200_000_000
_MEMORY_NS = 4_000_000_000
# Turns smaller than this, in deviations, say nothing.
_TELLING = 5.0
# Of the camera's turns and the gyroscope's, as a part of them, beyond the deviations.
_ALLOWED = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class Believed:
    """A frame with a pose, as the gyroscope is compared with it."""

    middle_ns: int
    rotation: Array  # (3,3) camera_from_map
    covariance: Array  # (3,3) of it, rad^2


class GyroscopeWatch:
    """Drops a gyroscope that contradicts the camera, finds out why, and takes it up again."""

    def __init__(self, settings: InertialSettings, filter_: GyroscopeFilter) -> None:
        self._settings, self._filter = settings, filter_
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self.dropped = Alone.NONE
        self.angle = 0.0
        self._contradictions: deque[bool] = deque(maxlen=_WATCHED)
        self._turns: deque[CameraTurn] = deque(maxlen=_KEPT)
        self._last: Believed | None = None
        self._samples: deque[tuple[IntArray, Array]] = deque()
        self._untried = 0

    def hear(self, samples: ImuSamples) -> None:
        """Keep the samples that are new."""
        newest = int(self._samples[-1][0][-1]) if self._samples else -(2**63)
        first = int(samples.times_ns.searchsorted(newest, "right"))
        if first < len(samples):
            self._samples.append((samples.times_ns[first:], samples.angular_velocity[first:]))
        while self._samples and self._samples[0][0][-1] < samples.times_ns[-1] - _MEMORY_NS:
            self._samples.popleft()

    @property
    def heard(self) -> tuple[IntArray, Array]:
        """Times (n,) in ns and rates (n,3) of the last seconds' samples."""
        if not self._samples:
            return np.zeros(0, np.int64), np.zeros((0, 3))
        times, rates = zip(*self._samples, strict=True)
        return np.concatenate(times), np.concatenate(rates)

    def judge(self, contradicts: bool, frame: Believed | None) -> None:
        """Take in a frame.

        Args:
            contradicts: the gyroscope.
            frame: its pose, if it was found without the gyroscope.
        """
        self._contradictions.append(contradicts)
        if frame is not None:
            self._follow(frame)
        if self.dropped is Alone.NONE:
            if sum(self._contradictions) >= _CONTRADICTIONS:
                self.dropped, self._untried = Alone.DISAGREES, 0
                self._filter.reset()  # what it learned of such a gyroscope is nothing
            return
        self._untried += 1
        if self._untried >= _TRY_EVERY:
            self._untried = 0
            self._explain()

    def _follow(self, frame: Believed) -> None:
        last, self._last = self._last, frame
        if last is None or not 0 < frame.middle_ns - last.middle_ns <= _LONGEST_PAIR_NS:
            return
        turn = frame.rotation @ last.rotation.T
        deviation = np.sqrt((np.trace(frame.covariance) + np.trace(last.covariance)) / 3.0)
        self._turns.append(CameraTurn(last.middle_ns, frame.middle_ns, turn, float(deviation)))

    def _explain(self) -> None:
        """Find a time offset that makes the two agree, or say that the mounting does not."""
        if not self._samples:
            return
        times, rates = self.heard
        fit = fit_offset(times, rates, self._turns)
        if fit is not None and fit.explains and self._settings.estimate_time_offset:
            self._filter.reset(fit.time_offset, 2.0 * fit.deviation)
            self.take_up()
            return
        shown, seen = self._compared(ImuSamples(times, rates))
        if len(seen) and np.sum((seen - shown) ** 2) < _ALLOWED * np.sum(seen**2):
            self.take_up()
            return
        mounting = fit_mounting(shown, seen) if len(seen) else None
        if mounting is not None and mounting.explains:
            self.dropped, self.angle = Alone.TURNED, mounting.angle
        else:
            self.dropped, self.angle = Alone.DISAGREES, 0.0

    def take_up(self) -> None:
        """Believe it again."""
        self.dropped, self.angle = Alone.NONE, 0.0
        self._contradictions.clear()

    def _compared(self, samples: ImuSamples) -> tuple[Array, Array]:
        """Turns (k,3) of gyroscope and camera, as rotation vectors; those that say something."""
        shown, seen = [], []
        for turn in self._turns:
            camera = so3.log(np.ascontiguousarray(turn.rotation.T))
            between = turn_between(samples, turn.from_ns, turn.to_ns, self._filter.errors)
            if between is not None and np.linalg.norm(camera) > _TELLING * turn.deviation:
                shown.append(so3.log(between.rotation.T.copy()))
                seen.append(camera)
        return np.array(shown).reshape(-1, 3), np.array(seen).reshape(-1, 3)

    def status(self, alone: Alone) -> InertialStatus:
        """What to tell."""
        errors = self._filter.errors
        *biases, offset = errors.covariance.diagonal().tolist()
        return InertialStatus(
            alone,
            errors.bias,
            math.sqrt(sum(biases) / len(biases)),
            errors.time_offset,
            math.sqrt(offset),
            self.angle,
        )


@kernel
def contradicts(step: Array, covariance: Array, places: IntArray) -> bool:
    """Whether a frame moved what stands at these places by more than its covariance allows."""
    count = len(places)
    block = np.empty((count, count))
    for i in range(count):
        for j in range(count):
            block[i, j] = covariance[places[i], places[j]]
    information = inverted(block)
    distance = 0.0
    for i in range(count):
        for j in range(count):
            distance += step[places[i]] * information[i, j] * step[places[j]]
    return not distance <= _MOST_SURPRISE
