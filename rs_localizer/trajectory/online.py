"""The readout time from neighbouring frames, while the camera runs.

One image shows how far the camera turns and travels during its readout; the poses of the frames
before and after it show how fast it does. The ratio is the readout time, negative where the
shutter runs against the direction that was assumed. Of each frame and its two neighbours,

    y = T x + noise,    y: mean motion per readout (Simpson's rule), x: way between the outer
                        poses by time,

both in the camera's axes, angular and linear (6). Both sides are noisy and their noise belongs
together, so that plain least squares would be biased, to anything at rest: the estimating equation
is corrected by what the frames' covariances expect of the noise. The deviation comes from the
scatter of the equation's own terms (a sandwich with Bartlett's weights), not from the covariances.

Each frame counts with what its image alone says (:mod:`rs_localizer.trajectory.image_alone`): the
estimate of a tracked frame believes in the readout time that the tracker was given.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera, ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate
from rs_localizer.trajectory.image_alone import image_alone

REVERSED = {
    ScanDirection.TOP_TO_BOTTOM: ScanDirection.BOTTOM_TO_TOP,
    ScanDirection.BOTTOM_TO_TOP: ScanDirection.TOP_TO_BOTTOM,
    ScanDirection.LEFT_TO_RIGHT: ScanDirection.RIGHT_TO_LEFT,
    ScanDirection.RIGHT_TO_LEFT: ScanDirection.LEFT_TO_RIGHT,
}
"""The opposite of each direction."""

# Motion before this (s) is forgotten.
_WINDOW = 10.0
# Neighbours farther away (s), or of intervals less alike than this, say little.
_LONGEST_INTERVAL, _MOST_UNLIKE = 0.15, 2.5
# Fewer triples than this have no scatter worth the name.
_LEAST_TRIPLES = 20
_MOST_POINTS = 200  # of a frame: more take longer than they are worth
_LAGS = 6  # neighbouring triples share frames, and errors of the map
_ROUNDS, _SETTLED = 12, 1e-4
# What a camera may do (rad/s, m/s): where the way is less certain than this, it says less.
_MOTION = np.diag(np.square([1.0, 1.0, 1.0, 0.5, 0.5, 0.5]))
_HUBER = 12.6  # squared length beyond which a triple counts less: 95 % of six degrees of freedom
_MEDIAN = 5.35  # median of chi-squared of six degrees of freedom
# Covariances of frames may be wrong by this share; so is the correction for noise at slow motion.
_COVARIANCE_ERROR = 0.5
_MODEL_ERROR = 0.005  # of Simpson's rule and of constant velocities in a frame
# Contradicted is a value that chance puts so far away as seldom as four deviations of a Gaussian,
# one-sided, and that is off by more than this share.
_CHANCE, _LEAST_DIFFERENCE = 3.2e-5, 0.06


@dataclass(frozen=True, slots=True)
class MeasuredReadout:
    """A readout time that the frames of the last seconds show."""

    readout_time: float  # s; negative: against the scan direction that was assumed
    deviation: float  # s
    triples: int  # frames with two neighbours

    def contradicts(self, readout_time: float) -> bool:
        """Whether this readout time (s, of the assumed direction) must be wrong."""
        off = abs(self.readout_time - readout_time)
        largest = max(abs(self.readout_time), readout_time)
        # Of few triples the deviation itself is uncertain: Student's t.
        deviations = float(stdtrit(self.triples / _LAGS, 1.0 - _CHANCE))
        return off > max(deviations * self.deviation, _LEAST_DIFFERENCE * largest)

    @property
    def relative_deviation(self) -> float:
        """Deviation by value."""
        return self.deviation / max(abs(self.readout_time), 1e-12)


class _View(NamedTuple):
    """One frame."""

    time_ns: int
    rotation: Array  # (3,3) map_from_camera
    position: Array  # (3,)
    motion: Array  # (6,) angular and linear per readout, of the image alone
    covariance: Array  # (12,12) of the image alone


class _Triple(NamedTuple):
    """One equation ``y = T x``, and the covariances of both sides."""

    time_ns: int
    x: Array  # (6,)
    y: Array  # (6,)
    xx: Array  # (6,6)
    yx: Array  # (6,6)
    yy: Array  # (6,6)


class ReadoutMonitor:
    """Measures the readout time over a sliding window of frames.

    Args:
        window: s.
    """

    def __init__(self, window: float = _WINDOW) -> None:
        self._window_ns = round(window * 1e9)
        self._views: deque[_View] = deque(maxlen=3)
        self._triples: deque[_Triple] = deque()

    def reset(self) -> None:
        """Forget all frames: the camera, the map or the assumed direction has changed."""
        self._views.clear()
        self._triples.clear()

    def add(
        self, time_ns: int, camera: Camera, estimate: Estimate, points: Array, pixels: Array
    ) -> None:
        """Take a frame whose middle row was exposed at ``time_ns``.

        Args:
            camera: its lens and scan direction count, its readout time does not.
            estimate: of this frame, tracked or not.
            points, pixels: (n,3) and (n,2) as they were localized.

        Frames come in order; one that does not follow the last starts afresh.
        """
        if self._views and time_ns <= self._views[-1].time_ns:
            self.reset()
        chosen = np.flatnonzero(estimate.inliers)
        chosen = chosen[:: 1 + len(chosen) // _MOST_POINTS]
        # Without accelerations and shaking: what a prior has wrong about the velocities, they mend.
        steady = Motion(
            estimate.rotation,
            estimate.translation,
            estimate.angular_velocity,
            estimate.linear_velocity,
        )
        alone = image_alone(camera, steady, points[chosen], pixels[chosen])
        if alone is None:
            self._views.clear()
            return
        offset, covariance = alone
        motion = np.concatenate([estimate.angular_velocity, estimate.linear_velocity])
        map_from_camera = estimate.rotation.T
        self._views.append(
            _View(
                time_ns,
                map_from_camera @ so3.exp(offset[:3]),
                estimate.position + map_from_camera @ offset[3:6],
                motion + offset[6:],
                covariance,
            )
        )
        if len(self._views) == 3:
            triple = _equation(*self._views)
            if triple is not None:
                self._triples.append(triple)
        while self._triples and self._triples[0].time_ns < time_ns - self._window_ns:
            self._triples.popleft()

    def measure(self) -> MeasuredReadout | None:
        """What the window shows; None as long as the motion determines nothing."""
        if len(self._triples) < _LEAST_TRIPLES:
            return None
        columns = list(zip(*self._triples, strict=True))[1:]
        return _solve(_Equations(*(np.array(column) for column in columns)))


def _equation(before: _View, now: _View, after: _View) -> _Triple | None:
    first = (now.time_ns - before.time_ns) * 1e-9
    second = (after.time_ns - now.time_ns) * 1e-9
    if max(first, second) > _LONGEST_INTERVAL or not (
        1.0 / _MOST_UNLIKE < first / second < _MOST_UNLIKE
    ):
        return None
    span = first + second
    # Integral of the parabola through three values (Simpson's rule for unlike intervals).
    shares = np.array(
        [
            (2.0 - second / first) / 6.0,
            span**2 / (6.0 * first * second),
            (2.0 - first / second) / 6.0,
        ]
    )
    back = now.rotation.T
    turned = so3.log(before.rotation.T @ now.rotation) + so3.log(back @ after.rotation)
    x = np.concatenate([turned, back @ (after.position - before.position)]) / span
    y, xx, yx, yy = np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6))
    for view, share, sign in zip((before, now, after), shares, (-1.0, 0.0, 1.0), strict=True):
        axes = np.zeros((6, 6))  # now from then; turns add up in the camera's own axes
        axes[:3, :3], axes[3:, 3:] = np.eye(3), back @ view.rotation
        y += share * axes @ view.motion
        by_pose, by_motion = sign / span * axes, share * axes
        xx += by_pose @ view.covariance[:6, :6] @ by_pose.T
        yx += by_motion @ view.covariance[6:, :6] @ by_pose.T
        yy += by_motion @ view.covariance[6:, 6:] @ by_motion.T
    return _Triple(now.time_ns, x, y, xx, yx, yy)


class _Equations(NamedTuple):
    """All triples of the window, stacked."""

    x: Array  # (n,6)
    y: Array  # (n,6)
    xx: Array  # (n,6,6)
    yx: Array  # (n,6,6)
    yy: Array  # (n,6,6)


class _Score(NamedTuple):
    """The estimating equation at one readout time."""

    terms: Array  # (n,) of which the sum is zero at the solution
    slope: float  # of the sum, without the part of the noise; negated
    noise: float  # part of the noise that was taken away


def _score(of: _Equations, value: float) -> _Score:
    """``sum of x*^T W (y - T x)``, where ``x*`` is the best guess of the way: what the noise of
    ``y - T x`` tells of that of ``x`` is taken out of it, so that both are independent, and it is
    shrunk towards rest where it is only noise.
    """
    error = of.y - value * of.x
    mixed = np.swapaxes(of.yx, 1, 2) - value * of.xx  # of the noise of x and of the error
    weights = np.linalg.inv(of.yy - value * (of.yx + np.swapaxes(of.yx, 1, 2)) + value**2 * of.xx)
    squared = np.einsum("ni,nij,nj->n", error, weights, error)
    scale = max(1.0, float(np.median(squared)) / _MEDIAN)
    robust = np.minimum(1.0, np.sqrt(_HUBER * scale / np.maximum(squared, 1e-12)))
    taken = mixed @ weights
    left = of.xx - taken @ np.swapaxes(mixed, 1, 2)
    shrink = _MOTION @ np.linalg.inv(_MOTION + left)
    way = np.einsum("nij,nj->ni", shrink, of.x - np.einsum("nij,nj->ni", taken, error))
    weights *= (robust / scale)[:, None, None]
    pulled = np.einsum("nij,nj->ni", weights, way)
    noise = float(np.einsum("nij,njk,nki->", weights, shrink, left))
    return _Score(np.sum(pulled * error, axis=1), float(np.sum(pulled * of.x)) - noise, noise)


def _solve(of: _Equations) -> MeasuredReadout | None:
    """The root of the estimating equation and its deviation."""
    value = 0.0
    score = _score(of, value)
    for _ in range(_ROUNDS):
        if not score.slope > max(score.noise, 1.0):
            return None  # the motion is not more than its noise
        step = float(np.sum(score.terms)) / score.slope
        value += step
        score = _score(of, value)
        if abs(step) < _SETTLED * abs(value):
            break
    variance = float(score.terms @ score.terms)
    for lag in range(1, _LAGS):
        share = 2.0 * (1.0 - lag / _LAGS)
        variance += share * float(score.terms[lag:] @ score.terms[:-lag])
    systematic = _COVARIANCE_ERROR * score.noise / score.slope
    deviation = math.sqrt(
        max(variance / score.slope**2, 1.0 / score.slope)
        + value**2 * (systematic**2 + _MODEL_ERROR**2)
    )
    return MeasuredReadout(value, deviation, len(of.x))
