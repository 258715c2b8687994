# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Mounts and clocks of the cameras of a rig, from recordings of each.

One motion runs through the keypoints of all cameras, that of the first one. Beside it each
camera has what one alone has (:mod:`rs_localizer.tools.camera_calibration`), and each but the
first :class:`.Extrinsics`. Cameras need not see the same: they see parts of one map.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.signal import argrelmax, correlate, correlation_lags
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.fit import Fit, cluster_robust, solve
from rs_localizer.tools.adjust.intrinsics import with_lens
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.row_kernels import EXTRINSICS
from rs_localizer.tools.adjust.spline import Spline, refined
from rs_localizer.tools.adjust.system import Undetermined
from rs_localizer.tools.adjust.variables import CameraView, Extrinsics, Unknowns
from rs_localizer.tools.camera_calibration import CameraCalibration, cut
from rs_localizer.tools.imu_mount import middle_row
from rs_localizer.tools.readout_belief import disagreement, discrepancy

# Turn rates are compared at this interval (s), over at least this time and this part of the shorter
# recording; this many of the offsets at which they agree best are tried.
_STEP, _LEAST_SECONDS, _LEAST_SHARE, _TRIED = 0.01, 2.0, 0.3, 10
# Rotation (rad) of the axes of two cameras of one body about their mean: half a step of the above
# at 5 rad/s, and a degree for splines of cameras whose lens is not known yet.
_MOST_TURNED = 0.05
# Parts of the recording that are estimated on their own.
_PARTS = 3
DETERMINED = math.radians(0.1), 5e-3, 1.5e-3
"""A turn, a place and an offset are determined to these deviations (rad, m, s): a hand's 67 deg/s
makes 0.1 deg of 1.5 ms, and frames of a pair notice extrinsics that are 0.2 deg or 1 cm off
(docs/rigs.md): by two deviations.
"""


@dataclass(frozen=True, slots=True, eq=False)
class Mounted:
    """A camera of a rig, estimated from all recordings, in the axes of the first camera."""

    camera: Camera  # with its lens; the readout time and scan direction it was assumed to have
    readout_time: float  # s; negative: against that direction
    # ``offset``: s, to add to its stamps, of first rows, for the time of the first camera's.
    extrinsics: Extrinsics
    deviations: Array  # (7,) of a step of these: rad, m, s

    @property
    def undetermined(self) -> str:
        """Names and figures of what the recording does not determine; empty: all is."""
        units = ("rotation", np.degrees(1.0), "deg"), ("position", 1e3, "mm"), ("clock", 1e3, "ms")
        largest = (float(np.max(of)) for of in np.split(self.deviations, [3, 6]))
        return ", ".join(
            f"{name} +- {unit * value:.2g} {of} (limit {unit * limit:.2g})"
            for (name, unit, of), value, limit in zip(units, largest, DETERMINED, strict=True)
            if not value < limit
        )


def calibrate_rig(found: Mapping[str, CameraCalibration]) -> dict[str, Mounted]:
    """Estimate extrinsics and clock offsets of a rig, by axes and clock of the first camera.

    Args:
        found: each camera's own calibration, by names.

    Raises:
        ValueError: for a single camera, or when the motions of two cameras are not one, or do not
            determine how the cameras are mounted; the message names the camera.
    """
    if len(found) < 2:
        raise ValueError(f"a rig has several cameras, not {len(found)}")
    first, *_ = found
    own = found[first]
    spline, start_ns = own.fit.state.spline, own.posed.start_ns
    spacing = min(each.fit.state.spline.layout.spacing for each in found.values())
    if spacing < spline.layout.spacing:
        spline = refined(spline, spacing)
    cameras, states = list[CameraView](), list[Unknowns]()
    for name, calibration in found.items():
        state, shift = calibration.fit.state, 1e-9 * (calibration.posed.start_ns - start_ns)
        # That of the camera's own calibration, with the accelerations of the rig.
        kept = ("lens", "lens_deviations", "landmarks", "paper", "stamps")
        alone = {of: getattr(calibration.fit.freedom, of) for of in kept}
        freedom = replace(own.fit.freedom, mount=name != first, **alone)
        if name != first:
            try:
                extrinsics = first_extrinsics(spline, state.spline, shift)
            except Undetermined as error:
                raise ValueError(f"{name}: {error}") from error
            state = replace(state, extrinsics=extrinsics)
        seen = calibration.posed.observations
        seen = replace(seen, times=seen.times + shift)
        seen = seen.subset(spline.layout.inside(seen.times + state.extrinsics.offset))
        states.append(replace(state, spline=spline, mount=None))
        cameras.append(CameraView(seen, freedom))
    noises = np.array([each.fit.deviation for each in found.values()])
    start = replace(states[0], others=tuple(states[1:]))
    try:
        whole = _Joint.of(Problem(cameras, start, noises), start)
    except Undetermined as error:
        raise ValueError(f"{', '.join(found)}: {error}") from error
    parts = list(_parts(whole))
    return {name: _mounted(place, whole, parts) for place, name in enumerate(found)}


def first_extrinsics(rig: Spline, own: Spline, shift: float) -> Extrinsics:
    """Return a first guess from the motions of rig and camera through one map.

    Args:
        shift: s, to add to the times of ``own`` for the stamps that the offset is to be added to.

    Raises:
        Undetermined: when the two do not turn alike at any offset.
    """
    grids = [_turning(spline) for spline in (rig, own)]
    (begin, speeds, known), (own_begin, own_speeds, own_known) = grids
    # Correlation coefficients of the turn rates at all offsets, where both are known.
    sums = {
        (a, b): correlate(known * speeds**a, own_known * own_speeds**b)
        for a, b in ((0, 0), (0, 1), (1, 0), (0, 2), (2, 0), (1, 1))
    }
    count = np.maximum(sums[0, 0], 1.0)
    products = sums[1, 1] - sums[1, 0] * sums[0, 1] / count
    spreads = [sums[2, 0] - sums[1, 0] ** 2 / count, sums[0, 2] - sums[0, 1] ** 2 / count]
    least = max(_LEAST_SECONDS / _STEP, _LEAST_SHARE * min(np.sum(known), np.sum(own_known)))
    alike = products / np.sqrt(np.maximum(spreads[0] * spreads[1], 1e-12))
    alike[sums[0, 0] < least] = -1.0
    peaks = argrelmax(alike, mode="wrap")[0]
    peaks = peaks[alike[peaks] > 0.0]
    lags = correlation_lags(len(speeds), len(own_speeds))[peaks[np.argsort(-alike[peaks])[:_TRIED]]]
    guesses = [_at_offset(rig, own, begin - own_begin + lag * _STEP) for lag in lags.tolist()]
    best, turned = min(guesses, key=lambda guess: guess[1], default=(None, math.inf))
    if best is None or not turned < _MOST_TURNED:
        raise Undetermined(
            "its rotation does not match that of the first camera"
            + (f" (to {math.degrees(turned):.1f} deg at best)" if guesses else "")
            + f": do both move as one, unevenly, and for {least * _STEP:.0f} s at the same time?"
        )
    return replace(best, offset=best.offset - shift)


def _turning(spline: Spline) -> tuple[float, Array, Array]:
    """Turn rates (n,) rad/s at even times from the first (s) on, and 1 where known, otherwise 0."""
    layout = spline.layout
    times = np.arange(layout.starts[0], layout.ends[-1], _STEP)
    speeds = np.linalg.norm(spline.states(times).angular, axis=1)
    return float(times[0]), speeds, layout.inside(times).astype(float)


def _at_offset(rig: Spline, own: Spline, offset: float) -> tuple[Extrinsics, float]:
    """Return extrinsics at a later time of the rig (s), and the spread (rad) of the axes."""
    times = np.arange(own.layout.starts[0], own.layout.ends[-1], _STEP)
    times = times[own.layout.inside(times) & rig.layout.inside(times + offset)]
    body, camera = rig.states(times + offset), own.states(times)
    axes = Rotation.from_matrix(np.swapaxes(camera.rotations, 1, 2) @ body.rotations)
    centres = np.einsum("nji,nj->ni", body.rotations, camera.positions - body.positions)
    mean = axes.mean()
    turned = float(np.median((axes * mean.inv()).magnitude()))
    return Extrinsics(mean.as_matrix(), np.median(centres, axis=0), offset), turned


class _Joint(NamedTuple):
    problem: Problem
    fit: Fit

    @classmethod
    def of(cls, problem: Problem, start: Unknowns) -> _Joint:
        """Return the estimate; errors of a second are taken together, unless times are free."""
        found = solve(problem, start)
        if any(camera.freedom.stamps > 0.0 for camera in problem.views):
            return cls(problem, found)
        return cls(problem, cluster_robust(problem, found))

    @property
    def states(self) -> tuple[Unknowns, ...]:
        """States of all cameras."""
        return self.fit.state, *self.fit.state.others

    def numbers(self, place: int, about: Extrinsics) -> tuple[Array, Array]:
        """Return rotation, displacement and clock offset about extrinsics, and deviations (7,)."""
        if place == 0:
            return np.zeros(EXTRINSICS), np.zeros(EXTRINSICS)
        problem, camera = self.problem, self.problem.views[place].camera
        own, first = self.states[place], self.states[0]
        # A stamp is that of the first row; the estimate compares the times of middle rows.
        later = middle_row(camera, own.readout_time)
        first_later = middle_row(self.problem.camera, first.readout_time)
        values = own.extrinsics.beside(replace(about, offset=later * own.readout_time))
        values[6] += first_later * first.readout_time
        by_border = np.zeros((EXTRINSICS, self.problem.border))
        by_border[:, problem.place("mount", place) :][:, :EXTRINSICS] = np.eye(EXTRINSICS)
        by_border[6, [problem.place("readout", place), 0]] = -later, first_later
        covariance = by_border @ self.fit.border_covariance @ by_border.T
        return values, np.sqrt(np.diag(covariance))


def _parts(whole: _Joint) -> Iterator[_Joint]:
    """Yield equal parts of the recording, each with all numbers of its own."""
    layout = whole.fit.state.spline.layout
    for start, end in pairwise(np.linspace(layout.starts[0], layout.ends[-1], _PARTS + 1)):
        state = cut(whole.fit.state, start, end)
        if state is None:
            continue
        views = []
        for view, one in zip(whole.problem.views, (state, *state.others), strict=True):
            times = view.observations.times + one.extrinsics.offset
            views.append(view.subset((times >= start) & (times < end)))
        with suppress(ValueError):  # undetermined, or without one of the cameras
            yield _Joint.of(Problem(views, state, whole.problem.ratios), state)


def _mounted(place: int, whole: _Joint, parts: list[_Joint]) -> Mounted:
    state = whole.states[place]
    extrinsics = state.extrinsics
    values, deviations = whole.numbers(place, extrinsics)
    if place > 0 and len(parts) > 1:
        each = np.array([part.numbers(place, extrinsics) for part in parts])
        for k, (own, noise) in enumerate(each.transpose(2, 1, 0)):
            inflation = disagreement(own, noise)
            beside = discrepancy(float(values[k]), own, inflation * noise)
            deviations[k] = math.hypot(inflation * deviations[k], beside)
    return Mounted(
        camera=with_lens(whole.problem.views[place].camera, state.lens),
        readout_time=state.readout_time,
        extrinsics=replace(extrinsics, offset=float(values[6])),
        deviations=deviations,
    )
