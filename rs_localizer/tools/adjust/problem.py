# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Cameras on one motion: which unknowns they have, the cost, and its least."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.tools.adjust.factors import (
    Floating,
    Gyroscope,
    acceleration_rows,
    block_rows,
    known,
    rest_rows,
)
from rs_localizer.tools.adjust.intrinsics import lens_prior
from rs_localizer.tools.adjust.reprojection import LIMIT, Reprojection
from rs_localizer.tools.adjust.row_kernels import EXTRINSICS, Curve, Projections
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.system import Factored, Groups, Quadratic, Rows, System, Undetermined
from rs_localizer.tools.adjust.variables import (
    MOUNT,
    CameraView,
    Pieces,
    Unknowns,
    paper_covariance,
)

# Errors beyond this many standard deviations do not count for the scale of the noise.
_SCALE_LIMIT = 4.0
MEDIAN = 2.0 * np.log(2.0)
"""Median of a squared error in two dimensions, in variances."""
_LOOSE_BODY = 100.0  # m, rad
_STEPS, _MOST_DAMPINGS = 20, 6
# A step that brings less than this, or than this part of the cost, is the last one; of a cost no
# larger than keypoints can make it: what is given tightly, and in conflict, must not end it.
_LEAST_GAIN, _LEAST_SHARE = 0.02, 1e-6
_FIRST_DAMPING = 1e-8
# The rounds end when the noise settles to this part of it.
_ROUNDS, _SETTLED = 8, 0.01


class Problem:
    """The cost of one motion that cameras see; borders and keypoints stand in their order.

    Args:
        views: of the cameras, of which the first has what is expected of the motion.
        start: first guess.
        noises: (k,) px, of each camera's keypoints; they keep their ratios (None: all alike).
        deviations: (p,) m, of landmarks that are all free and the same of all, and eliminated,
            about where they are observed to be; None: what the views' freedom says.
        floating: nothing holds the whole but its start.
    """

    def __init__(
        self, views: Sequence[CameraView], start: Unknowns, noises: Array | None = None,
        deviations: Array | None = None, floating: bool = False,
    ) -> None:  # fmt: skip
        self.views, self.deviations = list(views), deviations
        self.freedom, self.camera = self.views[0].freedom, self.views[0].camera
        noises = np.ones(len(self.views)) if noises is None else noises
        self.noises, self.ratios = noises, noises / noises[0]
        self._lens_priors = [lens_prior(v.camera, v.freedom.lens_deviations) for v in self.views]
        self.pieces = [_pieces(view, deviations is not None) for view in self.views]
        self._columns(start)
        pairs = list(zip(self.views, self.pieces, strict=True))
        self.keypoints = [Reprojection(*pair) for pair in pairs]
        self._shapes: list[Array | None] = []  # information on the shapes of flat prints
        for view, pieces in pairs:
            shape = None
            if view.freedom.paper and pieces.count and not pieces.rigid:
                landmarks = view.observations.landmarks[pieces.slots >= 0]
                shape = np.linalg.inv(paper_covariance(landmarks, view.freedom.landmarks))
            self._shapes.append(None if shape is None else np.asarray(shape))
        self.floating = Floating(start.spline) if floating else None
        self._last: tuple[Unknowns, Curve, list[Unknowns]] | None = None

    def _columns(self, start: Unknowns) -> None:
        """Number all unknowns: controls, each camera's border, landmarks of all, gyroscope."""
        controls = CONTROL * len(start.spline.positions)
        states, column = (start, *start.others), controls
        self.at: list[dict[str, slice]] = [{} for _ in states]  # by camera and name

        def number(view: int, name: str, size: int) -> None:
            nonlocal column
            if size:
                self.at[view][name] = slice(column, column + size)
                column += size

        for k, own in enumerate(states):
            free = self.views[k].freedom
            number(k, "readout", int(free.readout_time))
            number(k, "lens", len(own.lens) if free.lens else 0)
            number(k, "mount", EXTRINSICS if free.mount else 0)
            if self.deviations is None:
                number(k, "points", self.pieces[k].columns)
        self.gyro: Gyroscope | None = None
        gyro = self.views[0].observations.gyro
        if gyro is not None and start.mount is not None:
            self.gyro = Gyroscope(gyro, start)
            number(0, "gyro", MOUNT)
        kept = column
        for k, own in enumerate(states):
            if self.deviations is not None:  # the landmarks are those of all cameras
                column = kept
                number(k, "points", self.pieces[k].columns)
            elif self.views[k].freedom.stamps > 0.0:
                number(k, "delays", len(own.delays))
        width = 1 if self.deviations is None else 3
        self.groups = Groups(controls, kept - controls, (column - kept) // width, width)

    @property
    def border(self) -> int:
        """Unknowns that many keypoints share."""
        return self.groups.border

    def place(self, name: str, view: int = 0) -> int:
        """Return the index of a camera's first number in the border."""
        return int(self.at[view][name].start) - self.groups.motion

    def states(self, state: Unknowns) -> list[Unknowns]:
        """Return the unknowns of each camera, on one spline."""
        return self._on_spline(state)[1]

    def _on_spline(self, state: Unknowns) -> tuple[Curve, list[Unknowns]]:
        if self._last is None or self._last[0] is not state:
            spline = state.spline
            curve = Curve(
                spline.rotations, spline.positions, *spline.steps(), float(spline.layout.spacing)
            )
            others = [replace(other, spline=spline) for other in state.others]
            self._last = state, curve, [state, *others]
        return self._last[1:]

    def sights(self, state: Unknowns) -> list[Projections]:
        """Return the keypoints of each camera, on the spline."""
        curve, states = self._on_spline(state)
        return [of.projections(curve, own) for of, own in zip(self.keypoints, states, strict=True)]

    def keypoint_rows(self, state: Unknowns, deviation: float) -> list[Rows]:
        """Return the rows of each camera, at a standard deviation of the noise (px)."""
        curve, states = self._on_spline(state)
        parts = zip(self.keypoints, states, self.at, self.ratios.tolist(), strict=True)
        return [of.rows(curve, own, at, deviation * ratio) for of, own, at, ratio in parts]

    def system(self, state: Unknowns, deviation: float, dense: bool = False) -> System:
        """Return the cost and normal equations at a standard deviation of the noise (px)."""
        return System(self.groups, self.terms(state, deviation), dense)

    def terms(self, state: Unknowns, deviation: float) -> list[Rows | Quadratic]:
        """Return all measurements and priors."""
        terms: list[Rows | Quadratic] = [*self.keypoint_rows(state, deviation)]
        freedom, spline = self.freedom, state.spline
        terms.append(acceleration_rows(spline, freedom))
        if len(spline.layout.alone()) and freedom.angular_velocity < math.inf:
            terms.append(rest_rows(spline, freedom.angular_velocity, freedom.linear_velocity))
        for k, own in enumerate(self.states(state)):
            terms += self._known(k, own)
        if self.deviations is not None:
            offsets = state.landmarks - self.views[0].observations.landmarks
            terms.append(block_rows(offsets, self.deviations, self.groups.kept))
        if self.floating is not None:
            terms.append(self.floating.rows(spline))
        if self.gyro is not None:
            terms += self.gyro.terms(state, self.at[0]["gyro"].start)
        return terms

    def _known(self, k: int, own: Unknowns) -> list[Rows | Quadratic]:
        """Return the priors of a camera's unknowns."""
        terms: list[Rows | Quadratic] = []
        view, at, pieces = self.views[k], self.at[k], self.pieces[k]
        if "lens" in at:
            mean, information = self._lens_priors[k]
            terms.append(known(own.lens - mean, information, at["lens"].start))
        if "points" in at and self.deviations is None:
            offset = np.zeros(pieces.columns)
            deviation = _LOOSE_BODY  # a body none of whose landmarks fits stays where it is
            if not pieces.rigid:
                offset = (own.landmarks - view.observations.landmarks)[pieces.slots >= 0].ravel()
                deviation = max(view.freedom.landmarks, 1e-12)
            shape = self._shapes[k]
            matrix = np.eye(pieces.columns) * deviation**-2 if shape is None else shape
            terms.append(known(offset, matrix, at["points"].start))
        if "delays" in at:
            deviations = np.full(len(own.delays), view.freedom.stamps)
            terms.append(block_rows(own.delays[:, None], deviations, at["delays"].start))
        return terms

    def moved(self, state: Unknowns, step: Array) -> Unknowns:
        """Return the state after a step of all unknowns."""
        spline = state.spline.moved(step[: self.groups.motion])
        states = enumerate(self.states(state))
        first, *others = (self._camera_moved(k, own, step) for k, own in states)
        if self.gyro is not None and state.mount is not None:
            first = replace(first, mount=state.mount.moved(step[self.at[0]["gyro"]]))
        return replace(first, spline=spline, others=tuple(others))

    def _camera_moved(self, k: int, own: Unknowns, step: Array) -> Unknowns:
        by = {name: step[place] for name, place in self.at[k].items()}
        if "readout" in by:
            own = replace(own, readout_time=own.readout_time + float(by["readout"][0]))
        if "lens" in by:
            own = replace(own, lens=own.lens + by["lens"])
        if "mount" in by:
            own = replace(own, extrinsics=own.extrinsics.moved(by["mount"]))
        if "points" in by:
            own = replace(own, landmarks=self.pieces[k].moved(own.landmarks, by["points"]))
        if "delays" in by:
            own = replace(own, delays=own.delays + by["delays"])
        return own

    def errors(self, state: Unknowns) -> Array:
        """Return the squared whitened errors (n,), px^2 of the first camera."""
        curve, states = self._on_spline(state)
        parts = zip(self.keypoints, states, self.ratios, strict=True)
        return np.concatenate([of.squared_errors(curve, own) / r**2 for of, own, r in parts])

    def noise(self, state: Unknowns, deviation: float) -> float:
        """Return the noise deviation (px), from errors that count by the last one."""
        return max(noise_of(self.errors(state), deviation), self.freedom.least_noise)

    def trusted(self, start: Unknowns) -> Problem:
        """Return the problem with the trusted keypoints only."""
        views = [view.subset(view.observations.trusted) for view in self.views]
        return Problem(views, start, self.noises, self.deviations, self.floating is not None)

    def images(self, inliers: BoolArray) -> int:
        """Count images of all cameras with some of these keypoints (n,)."""
        frames = [view.observations.frames for view in self.views]
        parts = np.split(inliers, np.cumsum([len(own) for own in frames])[:-1])
        return sum(len(np.unique(of[own])) for of, own in zip(frames, parts, strict=True))


def minimise(problem: Problem, state: Unknowns, deviation: float) -> Unknowns:
    """Minimize the cost near a state, by Levenberg and Marquardt."""
    system = problem.system(state, deviation)
    damping = _FIRST_DAMPING
    most = LIMIT**2 / 3.0 * sum(len(view.observations.points) for view in problem.views)
    for _ in range(_STEPS):
        for _ in range(_MOST_DAMPINGS):
            cost = math.inf
            try:
                trial = problem.moved(state, Factored(system, damping).step())
                following = problem.system(trial, deviation)
                cost = following.cost
            except Undetermined:  # far from the minimum, rounding may cost definiteness
                pass
            if cost < system.cost + _LEAST_GAIN:  # NaN compares false
                break
            damping = max(100.0 * damping, 1e-4)
        else:
            return state
        gain = system.cost - cost
        state, system, damping = trial, following, 0.1 * damping
        if gain < max(_LEAST_GAIN, _LEAST_SHARE * min(cost, most)):
            break
    return state


def fit_with_noise(problem: Problem, state: Unknowns, deviation: float) -> tuple[Unknowns, float]:
    """State and noise (px) when neither changes any more."""
    for _ in range(_ROUNDS):
        state = minimise(problem, state, deviation)
        before, deviation = deviation, problem.noise(state, deviation)
        if abs(deviation - before) < _SETTLED * deviation:
            break
    return state, deviation


def noise_of(squared: Array, deviation: float) -> float:
    """Return the noise deviation, from squared errors (n,) that are near the last one.

    Raises:
        Undetermined: when there are none.
    """
    near = squared[squared < (_SCALE_LIMIT * deviation) ** 2]
    if len(near) == 0:
        raise Undetermined("no keypoint agrees with the motion of the frames")
    return float(np.sqrt(np.median(near) / MEDIAN))


def _pieces(view: CameraView, every: bool) -> Pieces:
    """Return the free parts of the map: all of it, bodies, or the landmarks that are seen."""
    observations, freedom = view.observations, view.freedom
    if every:
        return Pieces(np.arange(len(observations.landmarks)), rigid=False)
    if observations.bodies is not None:
        return Pieces(observations.bodies, rigid=True)
    slots = np.full(len(observations.landmarks), -1)
    if freedom.landmarks > 0.0:
        landmarks = np.unique(observations.points)
        slots[landmarks] = np.arange(len(landmarks))
    return Pieces(slots, rigid=False)
