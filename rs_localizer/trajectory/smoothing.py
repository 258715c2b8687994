"""The motion of a whole recording: poses and velocities at any time, with covariance.

What the keypoints say of a motion's accelerations (MacKay, "Bayesian interpolation", Neural
Computation 4, 1992).

The accelerations of an estimate are too small, as far as the prior took the place of what the
keypoints do not tell; and their squares are the sum of as many numbers only as these do tell.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.motion_model import FADING
from rs_localizer.trajectory.fit import Fit, cheaper, fit
from rs_localizer.trajectory.model import Freedom, Observations, start_state
from rs_localizer.trajectory.normal_kernels import changes
from rs_localizer.trajectory.observe import Observed, collect
from rs_localizer.trajectory.problem import LIMIT
from rs_localizer.trajectory.sight_kernels import Curve
from rs_localizer.trajectory.spline import LONGEST_SPACING, first_spline, refined

# What is known beforehand: as much as so many numbers of this size (rad/s^2, m/s^2) would tell. A
# few images that happen to lie on a line say nothing of those that follow.
_NUMBERS, _USUAL = 6.0, np.array([2.0, 1.0])


@dataclass(frozen=True, slots=True, eq=False)
class Told:
    """What an estimate says of its prior, of angular and of linear accelerations."""

    squares: Array  # (2,) sums, (rad/s^2)^2 and (m/s^2)^2
    numbers: Array  # (2,) how many of them the keypoints tell

    def most_likely(self, freedom: Freedom) -> Freedom:
        """The same with accelerations one step nearer to the greatest marginal likelihood."""
        squares = self.squares + _NUMBERS * _USUAL**2
        angular, linear = np.sqrt(squares / (np.maximum(self.numbers, 0.0) + _NUMBERS))
        return replace(
            freedom, angular_acceleration=float(angular), linear_acceleration=float(linear)
        )


def told(found: Fit) -> Told:
    """What an estimate says of the accelerations that were expected of it."""
    spline, firsts = found.state.spline, found.state.spline.layout.firsts
    about = np.concatenate([
        np.maximum(np.arange(first - 1, last - 3), first)
        for first, last in pairwise(firsts)
    ])  # fmt: skip
    curve = Curve(spline.rotations, spline.positions, *spline.steps(), spline.layout.spacing)
    prior, sums = found.freedom.accelerations(spline.layout.spacing), np.empty((2, 2))
    changes(curve, firsts, prior.memory, found.factored.local_covariances(about), sums)
    squares, variances = sums
    numbers = 3 * len(about) - variances / np.array([prior.angular, prior.linear]) ** 2
    return Told(squares, numbers)


# Between images the motion is told as long as its deviations stay within so many of the usual ones.
_MOST_UNCERTAIN = 5.0
# A sample is bridged where the images with a pose lie farther apart than this many intervals.
_BRIDGED = 1.5
# Where images show how accelerations fade, that bridges the knots (s) between them: these need not
# be as wide as a hand's motion would allow, and narrow ones follow all of it.
_NARROW_SPACING = 0.025
# A frame whose points lie this much farther from the smooth motion than from its own is shaken in a
# way that knots cannot follow: by so many times the noise, and beyond the chance (so many standard
# deviations) of its points. Where so much of the frames is, the motion between them is none.
_SHAKEN, _SHAKEN_SIGMAS, _MOST_SHAKEN = 1.5, 5.0, 0.2
# The expected accelerations are settled when they change by less than this part.
_ALIKE, _ROUNDS = 0.05, 6


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
        """Whether the image before or after these times (m,) is shaken."""
        after = np.clip(np.searchsorted(self.times, times), 0, len(self.times) - 1)
        before = np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)
        return self.shaken[before] | self.shaken[after]

    def _apart(self, times: Array) -> Array:
        """How far apart (m,) the images before and after these times are, s."""
        after = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        return self.times[after] - self.times[after - 1]

    def _in_camera(self, times: Array) -> Array:
        """Covariances (m,12,12) in the order and the axes of ``Estimate.covariance``, SI."""
        states = self.fit.state.spline.states(times)
        back = np.swapaxes(states.rotations, 1, 2)
        velocities = np.einsum("nij,nj->ni", back, states.linear)
        to_camera = np.zeros((len(times), 12, 12))
        to_camera[:, :3, :3] = to_camera[:, 6:9, 6:9] = np.eye(3)
        to_camera[:, 3:6, 3:6] = to_camera[:, 9:, 9:] = back
        to_camera[:, 9:, :3] = so3.hat(velocities)
        covariances: Array = (
            to_camera @ self.fit.state_covariances(times) @ np.swapaxes(to_camera, 1, 2)
        )
        return covariances

    def _estimates(self, times: Array, covariances: Array) -> list[Estimate]:
        states = self.fit.state.spline.states(times)
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


def smooth(
    camera: Camera, images: list[Observed], estimates: list[Estimate], stamp_offset: float = 0.0
) -> Smoothed:
    """The motion through images with a pose, in the order of their stamps.

    Args:
        camera: with its readout time.
        images: their inliers.
        estimates: a first motion of each image.
        stamp_offset: s from the stamp to the first row's exposure.

    Raises:
        ValueError: without a readout time, or when the images determine no motion.
    """
    readout_time = camera.readout_time
    if not readout_time > 0.0:
        raise ValueError("smoothing needs the readout time of the camera, which is 0 (unknown)")
    if not images:
        raise ValueError("no image has a pose: there is nothing to smooth")
    known = [
        replace(one, inliers=np.ones(len(image.points), dtype=np.bool_))
        for one, image in zip(estimates, images, strict=True)
    ]
    delay = stamp_offset - readout_time * camera.first_row_time
    posed = collect(camera, images, list(known), delay)
    seen = posed.observations
    interval = float(np.median(np.diff(posed.times))) if len(posed.times) > 1 else 1.0
    fading = FADING if interval < 0.5 * FADING else 0.0
    spacing = min(_NARROW_SPACING if fading else LONGEST_SPACING, interval)
    spline = first_spline(posed.times, posed.rotations, posed.positions, spacing, readout_time)
    seen = seen.subset(spline.layout.inside(seen.times))
    state = start_state(camera, seen, spline, readout_time)
    found = _lively(
        camera, seen, fit(camera, seen, state, Freedom(readout_time=False, fading=fading))
    )
    halved = replace(found.state, spline=refined(found.state.spline, 0.5 * spacing))
    finer = _lively(camera, seen, fit(camera, seen, halved, found.freedom, found.deviation))
    more = np.sum(told(finer).numbers) - np.sum(told(found).numbers)
    best = finer if cheaper(finer, found, float(more)) else found
    shaken = _shaken(best, seen, estimates)
    return Smoothed(best, readout_time, posed.start_ns, posed.times, shaken)


def _shaken(found: Fit, seen: Observations, estimates: list[Estimate]) -> BoolArray:
    """Which images (f,) shake in a way that the motion does not follow."""
    own = np.array([max(one.residual_rms, found.freedom.least_noise) ** 2 for one in estimates])
    count = np.bincount(seen.frames, minlength=len(estimates))
    # Robust, as the estimates are: outliers of the motion count as its limit.
    squared = np.minimum(found.squared_errors, (LIMIT * found.deviation) ** 2)
    off = np.bincount(seen.frames, squared, len(estimates)) / np.maximum(count, 1)
    # An estimate's errors are those of two coordinates, less what it took to fit them.
    left = np.maximum(1.0 - PARAMETERS / np.maximum(2 * count, 1), 0.1)
    limit = np.maximum(_SHAKEN**2, 1.0 + _SHAKEN_SIGMAS / np.sqrt(np.maximum(count, 1)))
    shaken = np.asarray((count > 0) & (off > limit * own / left), np.bool_)
    return np.ones_like(shaken) if shaken.mean() > _MOST_SHAKEN else shaken


def _lively(camera: Camera, seen: Observations, found: Fit) -> Fit:
    """With a prior of the accelerations that the motion itself shows."""
    for _ in range(_ROUNDS):
        before, freedom = found.freedom, told(found).most_likely(found.freedom)
        found = fit(camera, seen, found.state, freedom, found.deviation)
        changed = (
            freedom.angular_acceleration / before.angular_acceleration,
            freedom.linear_acceleration / before.linear_acceleration,
        )
        if np.all(np.abs(np.log(changed)) < _ALIKE):
            break
    return found
