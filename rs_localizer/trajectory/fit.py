"""The estimator of many frames: a spline through all keypoints, and what the frames share.

Gauss and Newton with Levenberg's damping on the whitened errors of
:mod:`rs_localizer.trajectory.normal_kernels`. The noise is not given: it is the scale of the
errors, measured between the rounds, and so Tukey's limit closes from the first guess to the noise.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.core.sampling import IntArray
from rs_localizer.core.so3 import Array
from rs_localizer.core.types import BoolArray
from rs_localizer.trajectory.banded import Factored, Undetermined
from rs_localizer.trajectory.lens import lens_values, project, with_lens
from rs_localizer.trajectory.normal_kernels import (
    Curve,
    Normal,
    Sights,
    Terms,
    accumulate,
    add_smoothness,
    eliminate_stamps,
    look,
    squared_errors,
)
from rs_localizer.trajectory.spline import Spline
from rs_localizer.trajectory.spline_kernels import CONTROL, LOCAL

# Tukey's limit in standard deviations: 97 % efficient on Gaussian noise in two dimensions.
_LIMIT = 6.0
# Errors beyond so many standard deviations do not count for the scale of the noise.
_SCALE_LIMIT = 4.0
# Median of a squared error in two dimensions, in variances.
_MEDIAN = 2.0 * np.log(2.0)
_LEAST_DEVIATION = 1e-4  # px; recordings without noise are simulated
_ROUNDS, _STEPS, _MOST_DAMPINGS = 8, 20, 6
# A round ends when a step lowers the cost by less than this; the rounds when the noise settles.
_LEAST_GAIN, _SETTLED = 0.02, 0.01
_FIRST_DAMPING = 1e-8


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Keypoints of all frames."""

    times: Array  # (n,) s, when the middle row of their frame was exposed, readout time aside
    row_times: Array  # (n,) -0.5 at the first exposed row, 0.5 at the last
    pixels: Array  # (n,2) raw
    landmarks: Array  # (p,3) m, map frame
    points: IntArray  # (n,) rows of ``landmarks``
    frames: IntArray  # (n,) number of the image, rising
    trusted: BoolArray  # (n,) inliers of their frame alone

    def subset(self, chosen: BoolArray) -> Observations:
        """The chosen keypoints (n,), with all landmarks."""
        names = ("times", "row_times", "pixels", "points", "frames", "trusted")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


@dataclass(frozen=True, slots=True)
class Freedom:
    """What is estimated beside the motion."""

    readout_time: bool = True
    lens: bool = False
    # Standard deviations of the given lens: focal lengths and centre by focal length, distortion.
    lens_deviations: tuple[float, float] = (0.02, 0.1)
    landmarks: float = 0.0  # m, standard deviation of their places; 0: they are known
    stamps: float = 0.0  # s, standard deviation of each image's stamp; 0: they are right
    angular_acceleration: float = 100.0  # rad/s^2, zero-mean prior at each control
    linear_acceleration: float = 50.0  # m/s^2


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All that is estimated."""

    spline: Spline
    readout_time: float  # s; negative: against the scan direction of the camera
    lens: Array  # (m,) as of lens_values
    landmarks: Array  # (p,3) m
    delays: Array  # (g,) s, how much later than stamped each image was exposed


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """An estimate with what is known of its errors."""

    state: State
    camera: Camera
    deviation: float  # px, standard deviation of the noise of u and of v
    cost: float  # sum of the weighted squared errors in noise variances
    squared_errors: Array  # (n,) px^2, whitened
    inliers: BoolArray  # (n,)
    border_covariance: Array  # (b,b): readout time, lens, landmarks as far as they are free
    freedom: Freedom
    factored: Factored
    inflation: float  # of all covariances, for robust weights and used up freedoms

    @property
    def readout_time_deviation(self) -> float:
        """Standard deviation of the readout time (s); NaN where it was given."""
        free = len(self.border_covariance) and self.freedom.readout_time
        return float(np.sqrt(self.border_covariance[0, 0])) if free else np.nan

    def state_covariances(self, times: Array) -> Array:
        """Covariances (m,12,12) at times (m,): turn in camera axes, position in the map, body
        rate (rad/s), velocity in the map (m/s).
        """
        first, jacobians = self.state.spline.jacobians(times)
        inner = self.inflation * self.factored.local_covariances(first)
        covariances: Array = jacobians @ inner @ np.swapaxes(jacobians, 1, 2)
        return covariances


def fit(
    camera: Camera,
    observations: Observations,
    start: State,
    freedom: Freedom,
    deviation: float | None = None,
) -> Fit:
    """The most likely motion and shared numbers.

    Args:
        camera: lens model, size and scan direction; its readout time and numbers do not matter.
        observations: all keypoints; those not trusted take part once the motion is about right.
        start: first guess; its knots stay.
        freedom: what is estimated.
        deviation: px, of the noise about the first guess if that is good; otherwise the trusted
            keypoints have to lead to it.

    Raises:
        Undetermined: when the keypoints do not determine what is free.
    """
    problem, state = _Problem(camera, observations, start, freedom), start
    if deviation is None:
        trusted = _Problem(camera, observations.subset(observations.trusted), start, freedom)
        state, deviation = _settle(trusted, start, trusted.noise(start, np.inf))
    state, deviation = _settle(problem, state, deviation)
    return problem.finish(state, deviation)


def cost_at(camera: Camera, observations: Observations, found: Fit, readout_time: float) -> float:
    """The least cost with this readout time (s), to be compared with ``found.cost``."""
    held = replace(found.freedom, readout_time=False)
    start = replace(found.state, readout_time=readout_time)
    problem = _Problem(camera, observations, start, held)
    return problem.normal(problem.minimise(start, found.deviation), found.deviation)[0]


def image_speeds(camera: Camera, observations: Observations, state: State) -> Array:
    """How fast the keypoints (n,) move in their images, px/s."""
    _, sights = _Problem(camera, observations, state, Freedom())._look(state)
    local, velocity = sights.local, sights.velocity
    by_ray = (velocity[:, :2] - velocity[:, 2:] * local[:, :2] / local[:, 2:]) / local[:, 2:]
    speeds: Array = np.linalg.norm(np.einsum("nij,nj->ni", sights.by_ray, by_ray), axis=1)
    return speeds


def _settle(problem: _Problem, state: State, deviation: float) -> tuple[State, float]:
    """State and noise when neither changes any more."""
    for _ in range(_ROUNDS):
        state = problem.minimise(state, deviation)
        before, deviation = deviation, problem.noise(state, deviation)
        if abs(deviation - before) < _SETTLED * deviation:
            break
    return state, deviation


class _Problem:
    """The cost of a state, its normal equations and its minimum."""

    def __init__(
        self, camera: Camera, observations: Observations, start: State, freedom: Freedom
    ) -> None:
        self.camera, self.observations, self.freedom = camera, observations, freedom
        self.start_lens = lens_values(camera)
        self.lens_count = len(start.lens) if freedom.lens else 0
        self.slots = np.full(len(start.landmarks), -1)
        if freedom.landmarks > 0.0:
            seen = np.unique(observations.points)
            self.slots[seen] = np.arange(len(seen))
        self.free_points = np.flatnonzero(self.slots >= 0)
        readout = 1 if freedom.readout_time else 0
        self.border = readout + self.lens_count + 3 * len(self.free_points)
        self.lens_column = readout if self.lens_count else -1
        self.point_column = readout + self.lens_count if len(self.free_points) else -1

    def _look(self, state: State) -> tuple[Curve, Sights]:
        seen, spline = self.observations, state.spline
        times = seen.times + state.delays[seen.frames] + state.readout_time * seen.row_times
        first, u = spline.layout.locate(times)
        curve = Curve(
            spline.rotations, spline.positions, *spline.steps(), float(spline.layout.spacing)
        )
        local, velocity = np.empty((len(first), 3)), np.empty((len(first), 3))
        look(curve, first, u, state.landmarks[seen.points], local, velocity)
        ahead = np.where(local[:, 2:] > 0.0, local, (0.0, 0.0, 1.0))
        seen_as = project(self.camera, state.lens, ahead, self.lens_column >= 0)
        sights = Sights(
            first, u, seen.row_times, local, velocity, seen_as.pixels - seen.pixels,
            seen_as.by_ray, seen_as.by_lens, self.slots[seen.points], seen.frames,
        )  # fmt: skip
        return curve, sights

    def _terms(self, state: State, deviation: float) -> Terms:
        return Terms(
            float(state.readout_time),
            self.camera.row_time_gradient,
            0 if self.freedom.readout_time else -1,
            self.lens_column,
            self.point_column,
            self.freedom.stamps > 0.0,
            deviation**2,
            (_LIMIT * deviation) ** 2,
        )

    def errors(self, state: State) -> Array:
        """Squared whitened errors (n,), px^2."""
        _, sights = self._look(state)
        out = np.empty(len(sights.first))
        squared_errors(sights, self._terms(state, 1.0), out)
        return out

    def noise(self, state: State, deviation: float) -> float:
        """Standard deviation of the noise, from the errors that are not far off the last one."""
        squared = self.errors(state)
        near = squared[squared < (_SCALE_LIMIT * deviation) ** 2]
        if len(near) == 0:
            raise Undetermined("no keypoint agrees with the motion of the frames")
        return max(float(np.sqrt(np.median(near) / _MEDIAN)), _LEAST_DEVIATION)

    def normal(self, state: State, deviation: float) -> tuple[float, Normal]:
        """Cost and normal equations."""
        curve, sights = self._look(state)
        normal = self._empty(len(state.spline.positions), sights, len(state.delays))
        cost = accumulate(curve, sights, self._terms(state, deviation), normal)
        cost += add_smoothness(
            curve, state.spline.layout.firsts, float(self.freedom.angular_acceleration),
            float(self.freedom.linear_acceleration), normal,
        )  # fmt: skip
        cost += self._add_priors(state, normal)
        if self.freedom.stamps > 0.0:
            eliminate_stamps(normal)
        return cost, normal

    def _empty(self, controls: int, sights: Sights, images: int) -> Normal:
        free = self.freedom.stamps > 0.0
        first, last = np.zeros(images, np.int64), np.zeros(images, np.int64)
        if free:
            begins = np.flatnonzero(np.diff(sights.frames, prepend=-1))
            first[sights.frames[begins]] = np.minimum.reduceat(sights.first, begins)
            last[sights.frames[begins]] = np.maximum.reduceat(sights.first, begins)
        width = LOCAL + CONTROL * int(np.max(last - first, initial=0))
        # The last images have no more controls behind them.
        first = np.minimum(first, max(controls - width // CONTROL, 0))
        count, images, border = CONTROL * controls, images if free else 0, self.border
        return Normal(
            np.zeros((width, count)), np.zeros((count, border)), np.zeros((border, border)),
            np.zeros(count), np.zeros(border), first[:images], np.zeros((images, width)),
            np.zeros((images, border)), np.zeros(images), np.zeros(images),
        )  # fmt: skip

    def _add_priors(self, state: State, normal: Normal) -> float:
        """What is known of lens and landmarks beforehand."""
        cost = 0.0
        diagonal = np.arange(self.border)
        if self.lens_column >= 0:
            pinhole, distortion = self.freedom.lens_deviations
            deviations = np.full(self.lens_count, distortion)
            deviations[:4] = pinhole * self.start_lens[:2].mean()
            offset = (state.lens - self.start_lens) / deviations
            at = slice(self.lens_column, self.lens_column + self.lens_count)
            normal.border_slope[at] += offset / deviations
            normal.corner[diagonal[at], diagonal[at]] += deviations**-2
            cost += float(offset @ offset)
        if self.point_column >= 0:
            known = self.observations.landmarks[self.free_points]
            offset = (state.landmarks[self.free_points] - known).ravel() / self.freedom.landmarks
            at = slice(self.point_column, self.border)
            normal.border_slope[at] += offset / self.freedom.landmarks
            normal.corner[diagonal[at], diagonal[at]] += self.freedom.landmarks**-2
            cost += float(offset @ offset)
        if self.freedom.stamps > 0.0:
            normal.image_information[:] += self.freedom.stamps**-2
            normal.image_slope[:] += state.delays * self.freedom.stamps**-2
            cost += float(np.sum((state.delays / self.freedom.stamps) ** 2))
        return cost

    def moved(self, state: State, normal: Normal, controls: Array, border: Array) -> State:
        """The state after a step that these normal equations led to."""
        readout_time, lens, landmarks = state.readout_time, state.lens, state.landmarks
        if self.freedom.readout_time:
            readout_time = readout_time + float(border[0])
        if self.lens_column >= 0:
            lens = lens + border[self.lens_column : self.lens_column + self.lens_count]
        if self.point_column >= 0:
            landmarks = landmarks.copy()
            landmarks[self.free_points] += border[self.point_column :].reshape(-1, 3)
        delays = state.delays
        if self.freedom.stamps > 0.0:
            width = normal.image_controls.shape[1]
            own = controls[CONTROL * normal.image_first[:, None] + np.arange(width)]
            pull = np.einsum("gk,gk->g", normal.image_controls, own) + normal.image_border @ border
            delays = delays - (normal.image_slope + pull) / normal.image_information
        return State(state.spline.moved(controls), readout_time, lens, landmarks, delays)

    def minimise(self, state: State, deviation: float) -> State:
        """The state of least cost near to this one."""
        cost, normal = self.normal(state, deviation)
        damping = _FIRST_DAMPING
        for _ in range(_STEPS):
            for _ in range(_MOST_DAMPINGS):
                trial = self.moved(state, normal, *Factored(normal, damping).step())
                trial_cost, trial_normal = self.normal(trial, deviation)
                if trial_cost < cost + _LEAST_GAIN:  # NaN compares false
                    break
                damping = max(100.0 * damping, 1e-4)
            else:
                return state
            gain = cost - trial_cost
            state, cost, normal, damping = trial, trial_cost, trial_normal, 0.1 * damping
            if gain < _LEAST_GAIN:
                break
        return state

    def finish(self, state: State, deviation: float) -> Fit:
        """The estimate with its covariances."""
        squared = self.errors(state)
        cost, normal = self.normal(state, deviation)
        factored = Factored(normal)
        inliers = squared < (_LIMIT * deviation) ** 2
        frames = len(np.unique(self.observations.frames[inliers]))
        used = self.border + CONTROL * min(frames, len(state.spline.positions))
        inflation = _inflation(squared[inliers], deviation, used)
        return Fit(
            state=state,
            camera=with_lens(
                replace(self.camera, readout_time=abs(state.readout_time)), state.lens
            ),
            deviation=deviation,
            cost=cost,
            squared_errors=squared,
            inliers=inliers,
            border_covariance=inflation * factored.border_covariance(),
            factored=factored,
            inflation=inflation,
            freedom=self.freedom,
        )


def _inflation(squared: Array, deviation: float, used: int) -> float:
    """How the covariance of the M-estimator differs from the inverse of its normal matrix.

    Huber's formula, ``E psi^2 / (E psi')^2``, where the matrix has the mean weight instead; and
    the freedoms that the motion used up.
    """
    share = squared / (_LIMIT * deviation) ** 2
    weight = (1.0 - share) ** 2
    psi_squared = np.mean(weight**2 * squared) / (2.0 * deviation**2)
    slope = np.mean(weight - 2.0 * share * (1.0 - share))
    freedoms = 2.0 * len(squared) / max(2.0 * len(squared) - used, 1.0)
    return float(psi_squared * np.mean(weight) / slope**2 * freedoms)


def start_state(
    camera: Camera, observations: Observations, spline: Spline, readout_time: float = 0.0
) -> State:
    """A first guess with the camera's own lens and the map as it is given."""
    delays = np.zeros(int(observations.frames.max(initial=-1)) + 1)
    return State(spline, readout_time, lens_values(camera), observations.landmarks.copy(), delays)
