# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
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

Each frame counts with what its image alone says (:func:`single_image_likelihood`): the estimate of
a tracked frame believes in the readout time that the tracker was given.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.blocks import write
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.core.simd.jit import inlined, kernel
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.refine import inverted
from rs_localizer.trajectory.readout_equations import (
    SIDE,
    Equations,
    MeasuredReadout,
    Measurement,
    View,
    equation,
    jumps,
)

# Directions that the image does not see: least eigenvalue of the information, diagonal scaled to 1.
_LEAST_EIGENVALUE = 1e-9
_LEAST_PACE = 0.1  # where rows overtake the image points, they say nothing
_LEAST_NOISE = 1e-4  # px
_PARAMETERS = 12
# A step in directions that the image hardly sees would leave the range of the linear model: the
# velocities stay within about this (rad, m per readout) of the given ones. The covariance says
# that such directions are not known.
_HELD = np.repeat([0.0, 0.0, 0.05**-2, 0.05**-2], 3)


def single_image_likelihood(
    camera: Camera, motion: Motion, points: Array, pixels: Array
) -> tuple[Array, Array] | None:
    """The step (12,) from a motion to what the image says, and its covariance (12,12).

    Order and units as of ``Estimate.covariance``: one Gauss-Newton step of the constant-velocity
    model on points (n,3) and raw pixels (n,2), all of them inliers, whose noise it leaves is
    theirs. None when they are too few.
    """
    if len(points) <= _PARAMETERS:
        return None
    tau = camera.row_time(pixels)
    omega, v = motion.angular_velocity, motion.linear_velocity
    turns, local = _seen(motion.rotation, motion.translation, omega, v, points, tau)
    projected, by_ray = camera.distort(
        local[:, :2] / np.where(local[:, 2:] > 0.0, local[:, 2:], 1.0)
    )
    information, slope, squared, count = _normal(
        turns, local, tau, omega, v, projected - pixels, by_ray, camera.row_time_gradient
    )
    if count <= _PARAMETERS:
        return None
    variance = max(squared / (2 * count - _PARAMETERS), _LEAST_NOISE**2)
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), 1e-300))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale)
    basis = scale[:, None] * vectors
    inverse = basis / np.maximum(values, _LEAST_EIGENVALUE) @ basis.T
    held = information + np.diag(variance * _HELD)
    return np.asarray(np.linalg.solve(held, -slope), np.float64), variance * inverse


@kernel
def _seen(
    rotation: Array, translation: Array, omega: Array, v: Array, points: Array, tau: Array
) -> tuple[Array, Array]:
    """Turns (n,3,3) from the middle row to each point's, and the points (n,3) in its axes."""
    count = len(points)
    turns, local = np.empty((count, 3, 3)), np.empty((count, 3))
    there = np.empty(3)
    for n in range(count):
        write(turns[n], so3.exp(-tau[n] * omega))
        for i in range(3):
            there[i] = translation[i] - tau[n] * v[i]
            for j in range(3):
                there[i] += rotation[i, j] * points[n, j]
        for i in range(3):
            local[n, i] = (
                turns[n, i, 0] * there[0] + turns[n, i, 1] * there[1] + turns[n, i, 2] * there[2]
            )
    return turns, local


@kernel
def _normal(
    turns: Array, local: Array, tau: Array, omega: Array, v: Array, errors: Array, by_ray: Array,
    gradient: Array,
) -> tuple[Array, Array, float, int]:  # fmt: skip
    """Normal equations (12,12) and (12,), sum of the squared errors, and how many points count.

    Noise moves a pixel to another row, too: errors and derivatives are multiplied by the inverse of
    ``I - flow gradient^T``, where ``flow`` is the pixel's motion in one readout.

    Args:
        turns, local: see :func:`_seen`.
        errors: (n,2) predicted less measured pixels.
        by_ray: (n,2,2) of the pixels by the rays.
        gradient: (2,) of the row time by the pixel.
    """
    information, slope = np.zeros((_PARAMETERS, _PARAMETERS)), np.zeros(_PARAMETERS)
    squared, used = 0.0, 0
    by_point, whitener, row = np.empty((2, 3)), np.empty((2, 2)), np.empty((2, _PARAMETERS))
    flow, error, moving = np.empty(2), np.empty(2), np.empty(3)
    g, turned, work = np.empty(3), np.empty(3), np.empty((4, 3))
    for n in range(len(local)):
        point = local[n]
        if not point[2] > 0.0:
            continue
        _cross(point, omega, moving)
        for i in range(3):
            for j in range(3):
                moving[i] -= turns[n, i, j] * v[j]
        for i in range(2):
            a, b = by_ray[n, i, 0] / point[2], by_ray[n, i, 1] / point[2]
            by_point[i, 0], by_point[i, 1] = a, b
            by_point[i, 2] = -(a * point[0] + b * point[1]) / point[2]
            flow[i] = a * moving[0] + b * moving[1] + by_point[i, 2] * moving[2]
        pace = 1.0 - flow[0] * gradient[0] - flow[1] * gradient[1]
        for i in range(2):
            for j in range(2):
                whitener[i, j] = flow[i] * gradient[j] / pace
            whitener[i, i] += 1.0
            error[i] = whitener[i, 0] * errors[n, 0] + whitener[i, 1] * errors[n, 1]
        if not (abs(pace) > _LEAST_PACE and np.isfinite(error[0]) and np.isfinite(error[1])):
            continue
        used += 1
        for i in range(2):
            squared += error[i] * error[i]
            for k in range(3):
                g[k] = whitener[i, 0] * by_point[0, k] + whitener[i, 1] * by_point[1, k]
            for k in range(3):
                turned[k] = g[0] * turns[n, 0, k] + g[1] * turns[n, 1, k] + g[2] * turns[n, 2, k]
            _line(g, turned, point, turns[n], tau[n], omega, v, work, row[i])
        for k in range(_PARAMETERS):
            slope[k] += row[0, k] * error[0] + row[1, k] * error[1]
            for m in range(_PARAMETERS):
                information[k, m] += row[0, k] * row[0, m] + row[1, k] * row[1, m]
    return information, slope, squared, used


@inlined
def _line(
    g: Array, turned: Array, point: Array, turn: Array, tau: float, omega: Array, v: Array,
    work: Array, line: Array,
) -> None:  # fmt: skip
    """Derivatives (12,) by the motion, from those ``g`` (3,) by the point in the row's axes.

    ``turned`` is ``g`` in the axes of the middle row.
    """
    by_turn, along, first, second = work[0], work[1], work[2], work[3]
    _cross(g, point, by_turn)
    _cross(turned, v, along)
    # The right Jacobian of the turn, to second order.
    _cross(by_turn, omega, first)
    _cross(first, omega, second)
    for k in range(3):
        line[k] = tau * along[k]
        for i in range(3):
            line[k] += by_turn[i] * turn[i, k]
        line[3 + k] = -turned[k]
        line[6 + k] = tau * (by_turn[k] - 0.5 * tau * first[k] + tau * tau / 6.0 * second[k])
        line[9 + k] = -tau * turned[k]


@kernel
def _cross(a: Array, b: Array, out: Array) -> None:
    out[0] = a[1] * b[2] - a[2] * b[1]
    out[1] = a[2] * b[0] - a[0] * b[2]
    out[2] = a[0] * b[1] - a[1] * b[0]


# What a triple says fades by this from triple to triple.
_MEMORY = 0.95
# Neighbouring triples share two frames, and the six numbers of each their errors: of what
# independent ones would say, this part.
_INDEPENDENT = 1.0 / 6.0
# Of the least mean square that any value leaves, what one triple may say: four of twenty are not
# enough to be certain, but one is to doubt.
_MOST = np.array([[3.9], [10.0]])
# Mean square of what changes at no readout time, in variances of its noise, that noise alone makes.
_MOST_SCATTER = 1.5
_CERTAIN = math.log(100.0)
# A camera that moves so much that the odds should be this (logarithm), if the setting were right,
# has to show at least a part of it.
_TELLING, _LEAST_SHOWN = 0.7, 0.5
# Odds (logarithm) of another value that are enough to doubt; at rest, chance makes less.
_DOUBT = 2.0
# Of the variance of the way's noise, what is taken from its square: it may be wrong, and scatters.
_WAY_NOISE = 2.0

# Places in sums of squares: what is left at no readout time, at that which is set, at its reverse;
# and how far the first two are from each other.
_NONE, _SET, _REVERSED, _APART = range(4)


class ShutterHypotheses:
    """Odds of a global shutter, and of a reversed one, against what is set, from few frames.

    A measured readout time needs a scatter, hence a second and more of motion. Which of three
    values fits is known sooner: the one that is set, none, or the one that is set with the other
    sign. Errors of map and lens look like velocities many times as large as noise makes them, but
    are alike in neighbouring frames: what changes from triple to triple is compared, and its own
    scatter is the measure. Of a global shutter nothing may remain beside noise: a shaken camera
    turns differently between its frames than within them, whatever its shutter. No triple counts
    for more than a few: a camera that jumps changes two of them.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all triples."""
        self._count = 0.0
        self._left = np.zeros((2, 4))  # to be certain, and to doubt

    def add(self, of: Equations, readout_time: float) -> None:
        """Compare the last two triples, one frame apart.

        Args:
            of: two or more.
            readout_time: s, that is set.
        """
        none, rolling = changed(of, 0.0), changed(of, readout_time)
        costs = np.array([none[0], rolling[0], changed(of, -readout_time)[0], rolling[1]])
        if np.all(np.isfinite(costs)):
            # Neighbouring triples share their noise: less changes than it would of others.
            usual = (np.min(self._left[0, :_APART]) + SIDE) / (self._count + 1.0)
            most = _MOST * max(np.min(costs[:_APART]), usual)
            self._count = _MEMORY * self._count + 1.0
            self._left = _MEMORY * self._left + np.minimum(costs, most)

    def _odds(self, one: int, other: int, to_doubt: bool = False) -> float:
        """Logarithm of the odds for one value against another."""
        costs = self._left[int(to_doubt)]
        return self._logarithm(float(costs[one]), float(costs[other]))

    def _logarithm(self, ours: float, theirs: float) -> float:
        if not min(ours, theirs) > 0.0:
            return 0.0
        return 0.5 * SIDE * _INDEPENDENT * self._count * math.log(theirs / ours)

    @property
    def logarithm(self) -> float:
        """Logarithm of the odds for a global shutter; 0 where nothing is known."""
        return self._odds(_NONE, _SET)

    @property
    def certain(self) -> bool:
        """Whether the shutter is a global one rather than one of the readout time that is set."""
        scatter = float(self._left[0, _NONE]) / (SIDE * max(self._count, 1.0))
        against = min(self.logarithm, self._odds(_NONE, _REVERSED))
        return scatter < _MOST_SCATTER and against > _CERTAIN

    @property
    def rolling(self) -> float:
        """Logarithm of the odds for the readout time that is set, either way, against none."""
        return max(self._odds(_SET, _NONE), self._odds(_REVERSED, _NONE))

    @property
    def may_be_reversed(self) -> bool:
        """Whether that fits better than what is set."""
        return self._odds(_REVERSED, _SET, to_doubt=True) > 0.0

    @property
    def shown(self) -> bool:
        """Whether the frames show what is set, as surely as they would have to deny it."""
        others = (self._odds(_SET, one, to_doubt=True) for one in (_NONE, _REVERSED))
        return min(others) > _DOUBT

    @property
    def doubtful(self) -> bool:
        """Whether the camera moves, and what is set does not show, or another value fits better."""
        least, apart = float(np.min(self._left[1, :_APART])), float(self._left[1, _APART])
        should = self._logarithm(least, least + apart)
        shown = self._odds(_SET, _NONE, to_doubt=True)
        silent = should > _TELLING and shown < _LEAST_SHOWN * should
        return silent or max(-shown, self._odds(_REVERSED, _SET, to_doubt=True)) > _DOUBT


@kernel
def changed(of: Equations, readout_time: float) -> tuple[float, float]:
    """Square of what changes between the last two triples at a readout time, in their variances.

    In variances of the newer one's noise; and how far that readout time is from none, beyond the
    noise of the way.
    """
    last = len(of.x) - 1
    change, displacement, spread = np.empty(SIDE), np.empty(SIDE), np.empty((SIDE, SIDE))
    for i in range(SIDE):
        change[i] = of.y[last, i] - of.y[last - 1, i]
        displacement[i] = readout_time * (of.x[last, i] - of.x[last - 1, i])
        change[i] -= displacement[i]
        for j in range(SIDE):
            both = of.yx[last, i, j] + of.yx[last, j, i]
            spread[i, j] = of.yy[last, i, j] - readout_time * both
            spread[i, j] += readout_time * readout_time * of.xx[last, i, j]
    weights = inverted(spread)
    squared, apart = 0.0, 0.0
    for i in range(SIDE):
        for j in range(SIDE):
            squared += change[i] * weights[i, j] * change[j]
            noise = of.xx[last, i, j] + of.xx[last - 1, i, j]
            noise *= _WAY_NOISE * readout_time * readout_time
            apart += weights[i, j] * (displacement[i] * displacement[j] - noise)
    return squared, max(apart, 0.0)


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


def _stacked(rows: Iterable[Equations]) -> Equations:
    """One behind the other in memory."""
    return Equations(*map(np.concatenate, zip(*rows, strict=True)))


def _of_three(views: Sequence[View], first: float, second: float) -> Equations:
    """The equation of three views, so many seconds apart."""
    side, covariance = (1, SIDE), (1, SIDE, SIDE)
    row = Equations(np.empty(side), np.empty(side), *(np.empty(covariance) for _ in range(3)))
    before, now, after = views
    equation(before, now, after, first, second, row, 0)
    return row


class ReadoutMonitor:
    """Measures the readout time over a sliding window of frames.

    Args:
        window: s.
    """

    def __init__(self, window: float = _WINDOW) -> None:
        self._window_ns = round(window * 1e9)
        self._views: deque[tuple[int, View]] = deque(maxlen=3)
        self._equations: deque[tuple[int, Equations]] = deque()
        self._in_a_row = 0  # triples, each one frame after the other
        self.odds = ShutterHypotheses()

    def reset(self) -> None:
        """Forget all frames: the camera, the map or the assumed direction has changed."""
        self._views.clear()
        self._equations.clear()
        self._in_a_row = 0
        self.odds.reset()

    def add(
        self, time_ns: int, camera: Camera, estimate: Estimate, points: Array, pixels: Array
    ) -> None:
        """Take a frame whose middle row was exposed at ``time_ns``.

        Args:
            camera: its lens and scan direction count; its readout time is compared with none.
            estimate: of this frame, tracked or not.
            points, pixels: (n,3) and (n,2) as they were localized.

        Frames come in order; one that does not follow the last starts afresh.
        """
        if self._views and time_ns <= self._views[-1][0]:
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
        alone = single_image_likelihood(camera, steady, points[chosen], pixels[chosen])
        if alone is None:
            self._views.clear()
            self._in_a_row = 0
            return
        offset, covariance = alone
        motion = np.concatenate([estimate.angular_velocity, estimate.linear_velocity])
        map_from_camera = estimate.rotation.T
        view = View(
            map_from_camera @ so3.exp(offset[:3]),
            estimate.position + map_from_camera @ offset[3:6],
            motion + offset[6:],
            covariance,
        )
        self._views.append((time_ns, view))
        if len(self._views) == 3:
            self._add_equation(camera.readout_time)
        while self._equations and self._equations[0][0] < time_ns - self._window_ns:
            self._equations.popleft()

    def _add_equation(self, readout_time: float) -> None:
        (before_ns, _), (now_ns, _), (after_ns, _) = self._views
        first, second = (now_ns - before_ns) * 1e-9, (after_ns - now_ns) * 1e-9
        before, now, after = (view for _, view in self._views)
        alike = 1.0 / _MOST_UNLIKE < first / second < _MOST_UNLIKE
        near = max(first, second) <= _LONGEST_INTERVAL
        if not (alike and near) or jumps(before, now, after, first, second):
            self._in_a_row = 0
            return
        self._equations.append((now_ns, _of_three((before, now, after), first, second)))
        self._in_a_row = min(self._in_a_row + 1, len(self._equations))
        if self._in_a_row > 1 and readout_time > 0.0:
            newest = (self._equations[k][1] for k in (-2, -1))
            self.odds.add(_stacked(newest), readout_time)

    def measure(self) -> MeasuredReadout | None:
        """What the window shows; None as long as the motion determines nothing.

        Raises:
            LinAlgError: a frame in the window has no covariance.
        """
        measurement = self.measurement()
        return None if measurement is None else measurement.finish()

    def measurement(self) -> Measurement | None:
        """The same, to be computed bit by bit; None as long as there are too few frames."""
        if len(self._equations) < _LEAST_TRIPLES:
            return None
        return Measurement(_stacked(row for _, row in self._equations))


def warm_up(camera: Camera) -> None:
    """Compile every kernel that frames of this camera may need, or load it from the cache."""
    pixels = np.random.default_rng(0).uniform(0.3, 0.7, (20, 2)) * camera.size
    points = np.column_stack([np.nan_to_num(camera.rays(pixels)), np.ones(len(pixels))])
    single_image_likelihood(camera, Motion(np.eye(3), *np.zeros((3, 3))), points, pixels)
    view = View(np.eye(3), np.zeros(3), np.zeros(SIDE), np.eye(2 * SIDE))
    row = _of_three([view, view, view], 1.0, 1.0)
    jumps(view, view, view, 1.0, 1.0)
    Measurement(row).finish()
    ShutterHypotheses().add(_stacked([row, row]), 1.0)
