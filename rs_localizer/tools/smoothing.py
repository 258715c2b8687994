# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of a whole recording: poses and velocities at any time, with covariance.

What the keypoints say of a motion's accelerations (MacKay, "Bayesian interpolation", Neural
Computation 4, 1992).

The accelerations of an estimate are too small, as far as the prior took the place of what the
keypoints do not tell; and their squares are the sum of as many numbers only as these do tell.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Rig
from rs_localizer.core.shake import shake_at
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS
from rs_localizer.core.types import Estimate
from rs_localizer.inertial.gyroscope_noise import SCALE_DEVIATION
from rs_localizer.inertial.turning import MOST_ROUGH
from rs_localizer.tools.adjust.fit import Fit, cheaper, solve
from rs_localizer.tools.adjust.motion import acceleration_rows
from rs_localizer.tools.adjust.observe import ImagePoints, collect
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.spline import LONGEST_SPACING, States, first_spline, refined
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.variables import (
    CameraView,
    Extrinsics,
    Freedom,
    SplineKeypoints,
    Unknowns,
    rig_state,
)

# What is known beforehand: as much as so many numbers of this size (rad/s^2, m/s^2) would tell. A
# few images that happen to lie on a line say nothing of those that follow.
_NUMBERS, _USUAL = 6.0, np.array([2.0, 1.0])


def told(fitted: Fit) -> tuple[Array, Array]:
    """Evidence of an estimate on the accelerations that were expected of it, angular and linear.

    Returns:
        their sums of squares (2,), (rad/s^2)^2 and (m/s^2)^2, and how many numbers (2,) the
        keypoints tell.
    """
    expected = fitted.freedom
    rows = acceleration_rows(fitted.state.spline, expected)
    spread = fitted.factored.local_covariances(rows.first // CONTROL)
    variances = np.einsum("nri,nij,nrj->nr", rows.values, spread, rows.values)
    each = np.array([rows.errors**2, variances]).reshape(2, len(rows.errors), 2, 3)
    squares, unknown = each.sum(axis=(1, 3))
    usual = np.array([expected.angular_acceleration, expected.linear_acceleration]) ** 2
    return usual * squares, 3 * len(rows.first) - unknown


# Between images the motion is told as long as its deviations stay within so many of the usual ones.
_MOST_UNCERTAIN = 5.0
# A sample is bridged where the images with a pose lie farther apart than this many intervals.
_BRIDGED = 1.5
# Where images show how accelerations fade, that bridges the knots (s) between them: these need not
# be as wide as a hand's motion would allow, and narrow ones follow all of it.
_NARROW_SPACING = 0.025
# s, in which accelerations fade: hands and drones change them about twice a second.
_FADING = 0.1
# A frame whose points lie this much farther from the smooth motion than from its own is shaken in a
# way that knots cannot follow: by so many times the noise, and beyond the chance (so many standard
# deviations) of its points. Where so much of the frames is, the motion between them is none.
_SHAKEN, _SHAKEN_SIGMAS, _MOST_SHAKEN = 1.5, 5.0, 0.2
# So are frames whose own in-frame turns move their points by more than their residual, as most of
# those next to them do: of a hand, 65 points at 1 px, at most one in twenty does by chance, of 0.3
# deg at 60 Hz all do, by 1.3 to 5.4 times.
_IN_FRAME, _NEXT = 1.0, 9
_ROWS = np.linspace(-0.5, 0.5, 17)
Parts = list[tuple[Camera, SplineKeypoints]]
"""The keypoints of each camera."""
# The expected accelerations are settled when they change by less than this part.
_ALIKE, _ROUNDS = 0.05, 6


# The gyroscopes' rates are taken at these steps (s), and what is slower than some 3 Hz is left to
# the knots (a Gaussian's deviation, s): with 16, 50 and 100 ms smoothed orientations were off by
# 0.042, 0.041, 0.041 deg and rates by 1.24, 1.15, 1.11 deg/s (tum_vi_room5 from 20 s on, 6 s,
# 0.3 deg at 60 Hz); the longer it is, the more a wrong scale of the gyroscope counts.
_STEP, _SLOW = 0.001, 0.05
# Of the first images, which do not know the offset of the IMU's stamps as well as the others do
# (standard deviations by the median), the rates are left out.
_MOST_DELAY = 3.0
# Rates may be missing for so long (s), a quarter of a period of 50 Hz, and in so much of the time.
_LONGEST_LACK, _MOST_LACKING = 0.005, 0.2
# Turns that move image points by less than this part of their noise are not worth it.
_LEAST_SHARE = 0.2


@dataclass(frozen=True, slots=True, eq=False)
class FastTurn:
    """The fast part of a camera's turn, as gyroscopes know it, beside which the motion is smooth.

    ``rotation = smooth_rotation turn(t)``: of the rates ``w`` and the slow ones ``s`` among them
    ``turn' = turn [w]x - [s]x turn``.
    """

    # Cubic splines, of the times (m,) and the order of a derivative.
    turns: Callable[..., Array]  # (m,3) rotation vectors
    rates: Callable[..., Array]  # (m,6) rad/s: all, and the slow ones
    covered: BoolArray  # (f,) frames whose rates it has
    vibrates: bool  # most of these frames turn in a way that no smooth motion follows
    times: Array  # (f,) s, of the frames' middle rows
    delays: Array  # (f,) s, standard deviations of their rates' times
    rate_noise: float  # rad/s, of a rate at one moment
    turn_noise: float  # rad, that it leaves in the turn

    def rotations(self, times: Array) -> Array:
        """Turns (m,3,3) at times (m,): from the camera's axes to those of the smooth motion."""
        rotations: Array = so3.exp_many(np.ascontiguousarray(self.turns(times)))
        return rotations

    def angular(self, times: Array, rotations: Array, smooth: Array) -> Array:
        """Body rates (m,3), rad/s, of the camera beside those of the smooth motion."""
        rates = self.rates(times)
        beside: Array = np.einsum("nji,nj->ni", rotations, smooth - rates[:, 3:]) + rates[:, :3]
        return beside

    def variances(self, times: Array) -> tuple[Array, Array]:
        """Variances (m,3) of turn (rad^2) and rate (rad^2/s^2) by what gyroscopes are off by."""
        turn, rate, change = (self.turns(times, order) for order in (0, 1, 2))
        delay = np.interp(times, self.times, self.delays)[:, None]
        return (
            (delay * rate) ** 2 + (SCALE_DEVIATION * turn) ** 2 + self.turn_noise**2,
            (delay * change) ** 2 + (SCALE_DEVIATION * rate) ** 2 + self.rate_noise**2,
        )


def fast_turn(times: Array, estimates: list[Estimate], readout_time: float) -> FastTurn | None:
    """The fast part of the turns that gyroscopes know at times (f,), s, of frames' middle rows.

    None: too few of the frames have one, or frames lie too far apart.
    """
    # These take a third of a second, which programs that smooth nothing do not wait for.
    from scipy.interpolate import CubicSpline
    from scipy.ndimage import gaussian_filter1d

    grid = np.arange(times[0] - readout_time, times[-1] + readout_time, _STEP)
    nearest = np.clip(np.searchsorted(0.5 * (times[1:] + times[:-1]), grid), 0, len(times) - 1)
    tau = (grid - times[nearest]) / readout_time
    rates = np.full((len(grid), 3), np.nan)
    delays = np.array([np.inf if one.turn is None else one.turn.delay for one in estimates])
    covered = delays <= _MOST_DELAY * np.median(delays)
    known = [(k, one.turn) for k, one in enumerate(estimates) if covered[k] and one.turn]
    edges = np.searchsorted(nearest, np.arange(len(times) + 1))
    for k, turn in known:
        own = np.arange(edges[k], edges[k + 1])
        own = own[(tau[own] >= turn.tau[0]) & (tau[own] <= turn.tau[-1])]
        rates[own] = turn.at_rows(tau[own])[1] / readout_time
    there = np.flatnonzero(np.isfinite(rates[:, 0]))
    if len(there) < 2:
        return None
    lacks = np.diff(there) * _STEP
    if lacks[lacks > _LONGEST_LACK].sum() > _MOST_LACKING * (grid[-1] - grid[0]):
        return None
    rates = np.column_stack([np.interp(grid, grid[there], rates[there, k]) for k in range(3)])
    slow = gaussian_filter1d(rates, _SLOW / _STEP, axis=0, mode="nearest")
    middles = [so3.exp_many(0.5 * _STEP * (r[1:] + r[:-1])) for r in (rates, slow)]
    turns = np.empty((len(grid), 3, 3))
    turns[0] = np.eye(3)
    for k, (fast, back) in enumerate(zip(middles[0], middles[1], strict=True)):
        turns[k + 1] = back.T @ turns[k] @ fast
    vectors = np.array([so3.log(turn) for turn in turns])
    noise = np.median([turn.rate_noise for _, turn in known])
    period = readout_time * np.median([np.median(np.diff(turn.tau)) for _, turn in known])
    return FastTurn(
        CubicSpline(grid, vectors),
        CubicSpline(grid, np.hstack([rates, slow])),
        covered,
        bool(np.median([turn.roughness for _, turn in known]) > MOST_ROUGH),
        times[covered],
        readout_time * delays[covered],
        float(noise / readout_time),
        float(noise / readout_time * np.sqrt(period * _SLOW)),
    )


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """The motion at m times."""

    estimates: list[Estimate]  # per readout, as of single frames; no keypoints
    determined: BoolArray  # (m,) by the images before and after
    bridged: BoolArray  # (m,) with images missing next to it


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The motion through all images of a recording."""

    fit: Fit
    readout_time: float  # s
    start_ns: int
    times: Array  # (f,) s since then, of the images' middle rows
    # (f,) images that shake faster than the motion: their own estimates are better.
    shaken: BoolArray
    fast: FastTurn | None = None  # beside which the fit is

    def sample(self, stamps_ns: IntArray) -> Sampled:
        """The camera's motion at times (m,) in ns."""
        times = np.array([(int(stamp) - self.start_ns) * 1e-9 for stamp in stamps_ns])
        spline = self.fit.state.spline
        covariances = self._in_camera(times)
        usual = np.median(_deviations(self._in_camera(self.times)), axis=0)
        certain = np.all(_deviations(covariances) < _MOST_UNCERTAIN * usual, axis=1)
        return Sampled(
            self._estimates(times, covariances),
            spline.layout.inside(times) & certain & ~self._beside_shaken(times),
            self._apart(times) > _BRIDGED * np.median(np.diff(self.times)),
        )

    def _beside_shaken(self, times: Array) -> BoolArray:
        """Times (m,) before or after which the image is shaken."""
        after = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        before = np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)
        return self.shaken[before] | self.shaken[after]

    def _apart(self, times: Array) -> Array:
        """How far apart (m,) the images before and after these times are, s."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        return self.times[after] - self.times[after - 1]

    def _states(self, times: Array) -> tuple[States, Array]:
        """Motion of the camera at times (m,), and turns (m,3,3) beside which it is smooth."""
        states = self.fit.state.spline.states(times)
        if self.fast is None:
            return states, np.broadcast_to(np.eye(3), states.rotations.shape)
        turns = self.fast.rotations(times)
        angular = self.fast.angular(times, turns, states.angular)
        return states._replace(rotations=states.rotations @ turns, angular=angular), turns

    def _in_camera(self, times: Array) -> Array:
        """Covariances (m,12,12) in the order and the axes of ``Estimate.covariance``, SI."""
        states, turns = self._states(times)
        back, beside = np.swapaxes(states.rotations, 1, 2), np.swapaxes(turns, 1, 2)
        velocities = np.einsum("nij,nj->ni", back, states.linear)
        to_camera = np.zeros((len(times), 12, 12))
        to_camera[:, :3, :3] = to_camera[:, 6:9, 6:9] = beside
        to_camera[:, 3:6, 3:6] = to_camera[:, 9:, 9:] = back
        to_camera[:, 9:, :3] = so3.hat(velocities) @ beside
        covariances: Array = (
            to_camera @ self.fit.state_covariances(times) @ np.swapaxes(to_camera, 1, 2)
        )
        if self.fast is not None:
            for first, added in zip((0, 6), self.fast.variances(times), strict=True):
                at = np.arange(first, first + 3)
                covariances[:, at, at] += added
        return covariances

    def _estimates(self, times: Array, covariances: Array) -> list[Estimate]:
        states, _ = self._states(times)
        scale = np.repeat([1.0, self.readout_time], 6)
        empty = np.zeros(0)
        # At a moment of its own nothing asks for accelerations.
        joint = np.zeros((len(times), PARAMETERS, PARAMETERS))
        joint[:, :MOTION_PARAMETERS, :MOTION_PARAMETERS] = scale[:, None] * covariances * scale
        return [
            Estimate(
                rotation=rotation.T,
                translation=-rotation.T @ position,
                angular_velocity=self.readout_time * angular,
                linear_velocity=self.readout_time * (rotation.T @ linear),
                inliers=empty.astype(np.bool_),
                residuals=empty,
                joint_covariance=covariance,
                global_shutter_inliers=0,
                iterations=0,
                span=self.readout_time,
            )
            for rotation, position, angular, linear, covariance in zip(
                states.rotations, states.positions, states.angular, states.linear, joint,
                strict=True,
            )
        ]  # fmt: skip


def _deviations(covariances: Array) -> Array:
    """Standard deviations (m,2) of orientation and position."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)
    sums = np.column_stack([variances[:, :3].sum(axis=1), variances[:, 3:6].sum(axis=1)])
    deviations: Array = np.sqrt(sums)
    return deviations


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrame:
    """A frame with a pose: what the cameras saw, by their names."""

    time_ns: int  # of the pose
    images: Mapping[str, ImagePoints]  # their inliers; stamps are exposures of first rows
    estimate: Estimate


def smooth(rig: Rig, frames: list[PosedFrame]) -> Smoothed:
    """The motion of a rig, or of a camera alone, through frames in their order.

    Args:
        rig: with the readout times of its cameras.
        frames: with a first motion each.

    Raises:
        ValueError: without a readout time, or when the frames determine no motion.
    """
    readout_time = next(iter(rig.cameras.values())).readout_time
    if not readout_time > 0.0:
        raise ValueError("smoothing needs the readout time of the camera, which is 0 (unknown)")
    if not frames:
        raise ValueError("no image has a pose: there is nothing to smooth")
    start_ns, estimates = frames[0].time_ns, [frame.estimate for frame in frames]
    times = np.array([(frame.time_ns - start_ns) * 1e-9 for frame in frames])
    spacing, fading = _knots(times)
    rotations = np.array([one.rotation.T for one in estimates])
    positions = np.array([one.position for one in estimates])
    parts, mounted = _parts(rig, frames, start_ns)
    fast = fast_turn(times, estimates, readout_time) if len(rig.cameras) == 1 else None
    if fast is not None:
        ((camera, seen),) = parts
        turned = _turned_pixels(camera, seen, fast, readout_time)
        moved = float(np.median(np.hypot(*(turned - seen.pixels).T)))
        if moved < _LEAST_SHARE * np.median([one.residual_rms for one in estimates]):
            fast = None
        else:
            parts = [(camera, replace(seen, pixels=turned))]
            rotations = rotations @ np.swapaxes(fast.rotations(times), 1, 2)
    longest = max(readout_time, *(one.span for one in estimates))
    spline = first_spline(times, rotations, positions, spacing, longest)
    parts = [
        (one, of.subset(spline.layout.inside(of.times) & np.isfinite(of.pixels[:, 0])))
        for one, of in parts
    ]
    start = rig_state(spline, ((*part, one) for part, one in zip(parts, mounted, strict=True)))
    best = _best(parts, start, fading)
    shaken = _shaken(best, parts, rig.focal_length, estimates)
    counted = shaken if fast is None else shaken[fast.covered]
    if counted.mean() > _MOST_SHAKEN:
        shaken[:] = True
    elif fast is not None and fast.vibrates:  # few images beside each other may look smooth
        shaken |= ~fast.covered
    return Smoothed(best, readout_time, start_ns, times, shaken, fast)


def _parts(rig: Rig, frames: list[PosedFrame], start_ns: int) -> tuple[Parts, list[Extrinsics]]:
    """The cameras that saw something, with their keypoints and mounts."""
    parts: Parts = []
    mounted: list[Extrinsics] = []
    for name, camera in rig.cameras.items():
        own = [k for k, frame in enumerate(frames) if name in frame.images]
        if not own:
            continue
        images = [frames[k].images[name] for k in own]
        known = [
            replace(frames[k].estimate, inliers=np.ones(len(image.points), np.bool_))
            for k, image in zip(own, images, strict=True)
        ]
        posed = collect(camera, images, list(known), -camera.readout_time * camera.first_row_time)
        seen, shift = posed.observations, (posed.start_ns - start_ns) * 1e-9
        parts.append(
            (camera, replace(seen, times=seen.times + shift, frames=np.array(own)[seen.frames]))
        )
        axes, moved = rig.camera_from_rig[name]
        mounted.append(Extrinsics(axes, -axes.T @ moved, 0.0))
    return parts, mounted


def _knots(times: Array) -> tuple[float, float]:
    """Spacing of the knots, and time in which accelerations fade (0: never), s, of times (f,)."""
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    fading = _FADING if interval < 0.5 * _FADING else 0.0
    return min(_NARROW_SPACING if fading else LONGEST_SPACING, interval), fading


def _problem(parts: Parts, state: Unknowns, freedom: Freedom) -> Problem:
    return Problem([CameraView(*part, freedom) for part in parts], state)


def _best(parts: Parts, start: Unknowns, fading: float) -> Fit:
    """With the accelerations that the motion shows, and finer knots if they are worth it."""
    freedom = Freedom(readout_time=False, fading=fading)
    fitted = _lively(parts, solve(_problem(parts, start, freedom), start))
    spline = fitted.state.spline
    halved = replace(fitted.state, spline=refined(spline, 0.5 * spline.layout.spacing))
    finer = solve(_problem(parts, halved, fitted.freedom), halved, fitted.deviation)
    finer = _lively(parts, finer)
    more = np.sum(told(finer)[1]) - np.sum(told(fitted)[1])
    return finer if cheaper(finer, fitted, float(more)) else fitted


def _turned_pixels(
    camera: Camera, observations: SplineKeypoints, fast: FastTurn, readout_time: float
) -> Array:
    """Pixels (n,2) as they would be without the fast turn; NaN where no image point is."""
    rays = np.column_stack([camera.rays(observations.pixels), np.ones(len(observations.pixels))])
    turns = fast.rotations(observations.times + readout_time * observations.row_times)
    return camera.project(np.einsum("nij,nj->ni", turns, rays))


def _shaken(fitted: Fit, parts: Parts, focal_length: float, estimates: list[Estimate]) -> BoolArray:
    """Which images (f,) shake in a way that the motion does not follow, by their keypoints."""
    frames = np.concatenate([seen.frames for _, seen in parts])
    own = np.array([max(one.residual_rms, fitted.freedom.least_noise) ** 2 for one in estimates])
    count = np.bincount(frames, minlength=len(estimates))
    # Robust, as the estimates are: outliers of the motion count as its limit.
    squared = np.minimum(fitted.squared_errors, (LIMIT * fitted.deviation) ** 2)
    off = np.bincount(frames, squared, len(estimates)) / np.maximum(count, 1)
    # An estimate's errors are those of two coordinates, less what it took to fit them.
    freedom = np.maximum(1.0 - PARAMETERS / np.maximum(2 * count, 1), 0.1)
    limit = np.maximum(_SHAKEN**2, 1.0 + _SHAKEN_SIGMAS / np.sqrt(np.maximum(count, 1)))
    shaken = (count > 0) & (off > limit * own / freedom)
    return np.asarray(shaken | _turns_in_frame(focal_length, estimates), np.bool_)


def _turns_in_frame(focal_length: float, estimates: list[Estimate]) -> BoolArray:
    """Which images (f,) turn within their exposure in a way that knots follow only in part."""
    turns = [
        shake_at(_ROWS, one.shake)[:, :3] if len(one.shake) else np.zeros(3) for one in estimates
    ]
    moved = focal_length * np.array([np.sqrt(np.mean(3.0 * turn**2)) for turn in turns])
    turning = moved > _IN_FRAME * np.array([one.residual_rms for one in estimates])
    around = np.ones(min(_NEXT, len(turning)))
    near, count = (np.convolve(of, around, "same") for of in (turning, np.ones(len(turning))))
    return np.asarray(turning & (near > 0.5 * count))


def _lively(parts: Parts, fitted: Fit) -> Fit:
    """With a prior of the accelerations that the motion itself shows.

    Each round is a step nearer to the greatest marginal likelihood.
    """
    for _ in range(_ROUNDS):
        before, (squares, numbers) = fitted.freedom, told(fitted)
        known = np.maximum(numbers, 0.0) + _NUMBERS
        angular, linear = np.sqrt((squares + _NUMBERS * _USUAL**2) / known).tolist()
        freedom = replace(before, angular_acceleration=angular, linear_acceleration=linear)
        problem = _problem(parts, fitted.state, freedom)
        fitted = solve(problem, fitted.state, fitted.deviation)
        changed = angular / before.angular_acceleration, linear / before.linear_acceleration
        if np.all(np.abs(np.log(changed)) < _ALIKE):
            break
    return fitted
