# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of many methods while one thing varies."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.experiments.methods import Method, estimate
from benchmarks.experiments.results import Context, Table, rounded
from benchmarks.experiments.trials import Motions, Setting, Trials, angles, draw_trials
from rs_localizer.core.arrays import Array

ORIENTATION, POSITION, W, T = range(4)
"""The errors of the paper's figures: deg, share of the distance, deg and units per frame."""
POSE = [ORIENTATION, POSITION]

Initial = Callable[[Trials, float], Array]


def motion_errors(found: Motions, truth: Motions) -> Array:
    """Errors (h,4) of orientation, position, w and t; infinite where nothing was found.

    The position's is relative to the camera's distance from the centre of the points.
    """
    distance = np.linalg.norm(truth.position, axis=1)
    errors = np.column_stack([
        angles(found.rotation, truth.rotation),
        np.linalg.norm(found.position - truth.position, axis=1) / distance,
        np.degrees(np.linalg.norm(found.w - truth.w, axis=1)),
        np.linalg.norm(found.t - truth.t, axis=1),
    ])  # fmt: skip
    return np.where(np.isnan(errors), np.inf, errors)


@dataclass(frozen=True, slots=True, eq=False)
class Curves:
    """Median errors of each method at each place of the sweep."""

    x: Array  # (m,)
    of: Mapping[str, Array]  # method -> (m,4)

    def medians(self, method: Method) -> Array:
        """Medians (m,4) of all metrics."""
        return self.of[method.name]

    def moving(self, method: Method) -> Array:
        """The same, but for the first place, where nothing moves."""
        return self.medians(method)[1:]

    def at(self, method: Method, metric: int, x: float) -> float:
        """Median at one of the places."""
        return float(self.medians(method)[np.argmin(np.abs(self.x - x)), metric])

    def orientations(self, unit: str, *places: float) -> str:
        """Medians of all methods at some places of the sweep, deg, as text."""
        columns = ("orientation (deg), motion:", *(f"{x:g} {unit}" for x in places))
        nearest = [np.argmin(np.abs(self.x - x)) for x in places]
        rows = [
            (name, *(rounded(float(values[k, ORIENTATION])) for k in nearest))
            for name, values in self.of.items()
        ]
        return Table(columns, rows).text()


def sweep(
    context: Context, x: Sequence[float], setting: Callable[[float], Setting],
    methods: Sequence[Method], initial: Initial | None = None,
) -> Curves:  # fmt: skip
    """Run the methods on ``context.trials`` frames at each place.

    Args:
        setting: what the place of the sweep means.
        initial: initial rotations (h,3,3) of the frames; default: the true ones.
    """
    found: dict[str, list[Array]] = {method.name: [] for method in methods}
    for value in context.track(x, len(x)):
        here = setting(value)
        trials = draw_trials(context.trials, context.seed, here)
        start = None if initial is None else initial(trials, value)
        for method in methods:
            motions = estimate(method, trials, start, here.noise)
            errors = motion_errors(motions, trials.truth)  # some may be infinite
            found[method.name].append(np.percentile(errors, 50.0, axis=0, method="nearest"))
    return Curves(np.array(x, float), {name: np.array(of) for name, of in found.items()})


def crossing(x: Array, rising: Array, level: Array) -> float:
    """Where a rising curve first passes a level, by linear interpolation; infinite if nowhere."""
    above = np.flatnonzero(rising > level)
    if len(above) == 0:
        return np.inf
    i = int(above[0])
    if i == 0:
        return float(x[0])
    before, after = rising[i - 1] - level[i - 1], rising[i] - level[i]
    return float(x[i - 1] + (x[i] - x[i - 1]) * before / (before - after))
