# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the cameras of a rig are on it, and how their clocks differ, from recordings of each.

One motion runs through the keypoints of all cameras, that of the first one. Beside it each camera
has what a calibration of its own has (:mod:`rs_localizer.trajectory.calibration`), and each but the
first :class:`.Extrinsics`. Cameras need not see the same: they see parts of one map.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.signal import correlate, correlation_lags
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.banded import Factored, Undetermined
from rs_localizer.trajectory.calibration import Calibration, cut, disagreement
from rs_localizer.trajectory.descent import settle
from rs_localizer.trajectory.fit import inflation_of
from rs_localizer.trajectory.model import Extrinsics, Observations, State
from rs_localizer.trajectory.normal_kernels import Normal
from rs_localizer.trajectory.problem import LIMIT, Problem, noise_of
from rs_localizer.trajectory.sight_kernels import EXTRINSICS
from rs_localizer.trajectory.spline import Spline, refined
from rs_localizer.trajectory.spline_kernels import CONTROL

# Turn rates are compared at this interval (s), over at least this time and this part of the shorter
# recording.
_STEP, _LEAST_SECONDS, _LEAST_SHARE = 0.01, 2.0, 0.3
# Two cameras of one body turn alike but for the errors of splines and frames without a pose.
_LEAST_CORRELATION = 0.5
# Parts of the recording that are estimated on their own.
_PARTS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """A camera of a rig as the recordings of all say; the axes are those of the first camera."""

    camera: Camera
    rotation: Array  # (3,3) camera_from_rig
    translation: Array  # (3,) m
    time_offset: float  # s, to add to its stamps for the time of the first camera's
    rotation_deviations: Array  # (3,) rad, of a turn about the camera's axes
    centre_deviations: Array  # (3,) m, of its place, along the rig's axes
    time_offset_deviation: float  # s
    # Of the seven above one after the other: what parts of the recording say by themselves makes
    # them so much larger; 1: nothing.
    inflations: Array
    readout_time: float  # s; negative: against the scan direction of ``camera``


class Recording(NamedTuple):
    """One camera's part: what it was calibrated with, and what came of it."""

    camera: Camera
    calibration: Calibration


def calibrate_rig(recordings: Mapping[str, Recording]) -> dict[str, Mounted]:
    """Extrinsics and clock offsets of the cameras of a rig, by their names; the first one's axes
    and clock are those of the rig.

    Raises:
        ValueError: for a single camera, or when the motions of two cameras are not one, or do not
            determine how the cameras are mounted; the message names the camera.
    """
    if len(recordings) < 2:
        raise ValueError("a rig has several cameras; the recording shows one")
    first, *others = recordings
    own = recordings[first].calibration
    spline, start_ns = own.fit.state.spline, own.posed.start_ns
    spacing = min(each.calibration.fit.state.spline.layout.spacing for each in recordings.values())
    if spacing < spline.layout.spacing:
        spline = refined(spline, spacing)
    cameras: list[Problem] = []
    states: list[State] = []
    for name, (camera, found) in recordings.items():
        state, shift = (
            replace(found.fit.state, spline=spline),
            1e-9 * (found.posed.start_ns - start_ns),
        )
        freedom = replace(own.fit.freedom, **_own_freedom(found))
        if name != first:
            try:
                placed = first_extrinsics(spline, found.fit.state.spline, shift)
            except Undetermined as error:
                raise ValueError(f"{name}: {error}") from error
            state = replace(state, extrinsics=placed)
            freedom = replace(freedom, extrinsics=True)
        seen = found.posed.observations
        seen = replace(seen, times=seen.times + shift)
        seen = seen.subset(spline.layout.inside(seen.times + state.extrinsics.offset))
        cameras.append(Problem(camera, seen, state, freedom))
        states.append(state)
    noises = np.array([each.calibration.fit.deviation for each in recordings.values()])
    try:
        whole = _fit(cameras, noises, states)
    except Undetermined as error:
        raise ValueError(f"{', '.join(recordings)}: {error}") from error
    parts = list(_parts(cameras, noises, whole))
    return {
        name: _mounted(recordings, place, whole, parts) for place, name in enumerate(recordings)
    }


def _own_freedom(found: Calibration) -> dict[str, object]:
    """What a camera's own calibration freed; accelerations are those of the rig."""
    names = ("lens", "lens_deviations", "landmarks", "paper", "stamps")
    return {name: getattr(found.fit.freedom, name) for name in names}


def first_extrinsics(rig: Spline, own: Spline, shift: float) -> Extrinsics:
    """A first guess, from the motions of the rig and of the camera alone through one map.

    Args:
        shift: s, to add to the times of ``own`` for the stamps that the offset is to be added to.

    Raises:
        Undetermined: when the two do not turn alike at any offset.
    """
    times, speeds, known = zip(*(_turning(spline) for spline in (rig, own)), strict=True)
    # Correlation coefficients of the turn rates at all offsets, where both are known.
    sums = {
        (a, b): correlate(known[0] * speeds[0] ** a, known[1] * speeds[1] ** b)
        for a, b in ((0, 0), (0, 1), (1, 0), (0, 2), (2, 0), (1, 1))
    }
    count = np.maximum(sums[0, 0], 1.0)
    products = sums[1, 1] - sums[1, 0] * sums[0, 1] / count
    spreads = [sums[2, 0] - sums[1, 0] ** 2 / count, sums[0, 2] - sums[0, 1] ** 2 / count]
    least = max(_LEAST_SECONDS / _STEP, _LEAST_SHARE * min(map(np.sum, known)))
    alike = products / np.sqrt(np.maximum(spreads[0] * spreads[1], 1e-12))
    alike[sums[0, 0] < least] = -1.0
    best = int(np.argmax(alike))
    if alike[best] < _LEAST_CORRELATION:
        raise Undetermined(
            f"its turns are not those of the first camera (correlation {alike[best]:.2f} at best "
            f"over {least * _STEP:.0f} s or more): do they move as one, and at the same time?"
        )
    lag = float(correlation_lags(len(speeds[0]), len(speeds[1]))[best]) * _STEP
    offset = times[0][0] - times[1][0] + lag  # of the rig's time beside the camera's
    at = times[1][known[1] > 0.0]
    at = at[rig.layout.inside(at + offset)]
    body, seen = rig.states(at + offset), own.states(at)
    axes = np.swapaxes(seen.rotations, 1, 2) @ body.rotations
    centres = np.einsum("nji,nj->ni", body.rotations, seen.positions - body.positions)
    mean = Rotation.from_matrix(axes).mean().as_matrix()
    return Extrinsics(mean, np.median(centres, axis=0), offset - shift)


def _turning(spline: Spline) -> tuple[Array, Array, Array]:
    """Even times (n,), turn rates (n,) rad/s there, and 1 where they are known, otherwise 0."""
    layout = spline.layout
    times = np.arange(layout.starts[0], layout.ends[-1], _STEP)
    known = layout.inside(times).astype(float)
    return times, np.linalg.norm(spline.states(times).angular, axis=1), known


class _RigState(NamedTuple):
    cameras: tuple[State, ...]  # of one spline


class _RigNormal(NamedTuple):
    whole: Normal
    own: list[Normal]  # of each camera


class _RigProblem:
    """The cost of all cameras, and its normal equations; the borders stand one after the other.

    Args:
        cameras: of which the first has what is expected of the motion.
        noises: (k,) px, of each camera; the deviation of the noise is in units of these.
    """

    def __init__(self, cameras: list[Problem], noises: Array) -> None:
        self.cameras, self.noises = cameras, noises
        ends = np.cumsum([0, *(camera.border for camera in cameras)]).tolist()
        self.columns = [slice(a, b) for a, b in pairwise(ends)]

    def normal(self, state: _RigState, deviation: float) -> tuple[float, _RigNormal]:
        cost, own = 0.0, []
        for camera, one, noise in zip(self.cameras, state.cameras, self.noises, strict=True):
            added, normal = camera.normal(one, deviation * float(noise), motion=not own)
            own.append(normal)
            cost += added
        border, count = self.columns[-1].stop, len(own[0].slope)
        whole = own[0]._replace(
            band=np.zeros((max(len(normal.band) for normal in own), count)),
            cross=np.zeros((count, border)),
            corner=np.zeros((border, border)),
            slope=np.zeros(count),
            border_slope=np.zeros(border),
        )
        for normal, at in zip(own, self.columns, strict=True):
            whole.band[: len(normal.band)] += normal.band
            whole.slope[:] += normal.slope
            whole.cross[:, at] = normal.cross
            whole.corner[at, at] = normal.corner
            whole.border_slope[at] = normal.border_slope
        return cost, _RigNormal(whole, own)

    def step(self, normal: _RigNormal, damping: float) -> tuple[Array, Array]:
        return Factored(normal.whole, damping).step()

    def moved(self, state: _RigState, normal: _RigNormal, step: tuple[Array, Array]) -> _RigState:
        controls, border = step
        cameras = [
            camera.moved(one, own, (controls, border[at]))
            for camera, one, own, at in zip(
                self.cameras, state.cameras, normal.own, self.columns, strict=True
            )
        ]
        spline = cameras[0].spline
        return _RigState(tuple(replace(camera, spline=spline) for camera in cameras))

    def errors(self, state: _RigState) -> Array:
        """Squared whitened errors of all keypoints, in the noises' variances."""
        pairs = zip(self.cameras, state.cameras, self.noises, strict=True)
        return np.concatenate([camera.errors(one) / noise**2 for camera, one, noise in pairs])

    def noise(self, state: _RigState, deviation: float) -> float:
        return noise_of(self.errors(state), deviation)


class _Joint(NamedTuple):
    """The estimate of all cameras."""

    state: _RigState
    covariance: Array  # (b,b) of the border
    places: list[tuple[int, int]]  # in it, of each camera's readout time and extrinsics; -1: none


def _fit(cameras: list[Problem], noises: Array, states: list[State]) -> _Joint:
    start = _RigState(tuple(states))
    # A first guess of the extrinsics is off by more than the noise, outliers by more than that.
    trusted = _RigProblem(
        [_trusted(camera, one) for camera, one in zip(cameras, states, strict=True)], noises
    )
    state, deviation = settle(trusted, start, trusted.noise(start, np.inf))
    problem = _RigProblem(cameras, noises)
    state, deviation = settle(problem, state, deviation)
    factored = Factored(problem.normal(state, deviation)[1].whole)
    squared = problem.errors(state)
    squared = squared[squared < (LIMIT * deviation) ** 2]
    used = problem.columns[-1].stop + CONTROL * len(state.cameras[0].spline.positions)
    covariance = inflation_of(squared, deviation, used) * factored.border_covariance()
    places = [
        (at.start, at.start + camera.mount_column if camera.mount_column >= 0 else -1)
        for camera, at in zip(cameras, problem.columns, strict=True)
    ]
    return _Joint(state, covariance, places)


def _trusted(camera: Problem, state: State) -> Problem:
    seen = camera.observations
    return _of(camera, seen.subset(seen.trusted), state)


def _of(camera: Problem, seen: Observations, state: State) -> Problem:
    """The same camera with other keypoints."""
    return Problem(camera.camera, seen, state, camera.freedom)


def _parts(cameras: list[Problem], noises: Array, whole: _Joint) -> Iterator[_Joint]:
    """Equal parts of the recording, each with all numbers of its own."""
    states = whole.state.cameras
    layout = states[0].spline.layout
    for start, end in pairwise(np.linspace(layout.starts[0], layout.ends[-1], _PARTS + 1)):
        longest = max(states, key=lambda state: abs(state.readout_time))
        part = cut(longest, start, end)
        if part is None:
            continue
        own, problems = [replace(state, spline=part.spline) for state in states], []
        for camera, state in zip(cameras, own, strict=True):
            seen = camera.observations
            times = seen.times + state.extrinsics.offset
            problems.append(_of(camera, seen.subset((times >= start) & (times < end)), state))
        with suppress(ValueError):  # undetermined, or without one of the cameras
            yield _fit(problems, noises, own)


def _mounted(
    recordings: Mapping[str, Recording], place: int, whole: _Joint, parts: list[_Joint]
) -> Mounted:
    camera, found = list(recordings.values())[place]
    state = whole.state.cameras[place]
    values, deviations = _numbers(recordings, place, whole, state.extrinsics)
    inflations = np.ones(EXTRINSICS)
    if place > 0 and len(parts) > 1:
        each = [_numbers(recordings, place, part, state.extrinsics) for part in parts]
        inflations = np.array([
            disagreement(*(np.array([pair[k][i] for pair in each]) for k in range(2)))
            for i in range(EXTRINSICS)
        ])  # fmt: skip
    deviations = deviations * inflations
    return Mounted(
        camera=found.fit.camera,
        rotation=state.extrinsics.axes,
        translation=-state.extrinsics.axes @ state.extrinsics.centre,
        time_offset=float(values[6]),
        rotation_deviations=deviations[:3],
        centre_deviations=deviations[3:6],
        time_offset_deviation=float(deviations[6]),
        inflations=inflations,
        readout_time=state.readout_time,
    )


def _numbers(
    recordings: Mapping[str, Recording], place: int, joint: _Joint, about: Extrinsics
) -> tuple[Array, Array]:
    """Turn and displacement beside some extrinsics, and the offset of the stamps of first rows;
    and their deviations (7,) by the noise.
    """
    rows = [each.camera.first_row_time for each in recordings.values()]
    states, (readout, column) = joint.state.cameras, joint.places[place]
    own = states[place].extrinsics
    if place == 0:
        return np.zeros(EXTRINSICS), np.zeros(EXTRINSICS)
    turn = so3.log(np.ascontiguousarray(own.axes @ about.axes.T))
    # A stamp is that of the first row; the estimate compares the times of middle rows.
    by_border = np.zeros((EXTRINSICS, len(joint.covariance)))
    by_border[np.arange(EXTRINSICS), column + np.arange(EXTRINSICS)] = 1.0
    by_border[6, readout], by_border[6, joint.places[0][0]] = rows[place], -rows[0]
    offset = (
        own.offset + rows[place] * states[place].readout_time - rows[0] * states[0].readout_time
    )
    covariance = by_border @ joint.covariance @ by_border.T
    return np.r_[turn, own.centre - about.centre, offset], np.sqrt(np.diag(covariance))
