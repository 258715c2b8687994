# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The minimum of a cost, by Gauss and Newton with Levenberg's damping; and of the noise with it."""

from __future__ import annotations

from typing import Protocol, TypeVar

import numpy as np

from rs_localizer.trajectory.banded import Undetermined
from rs_localizer.trajectory.model import State

_STEPS, _MOST_DAMPINGS = 20, 6
# A step that brings less than this, or than this part of the cost, is the last one.
_LEAST_GAIN, _LEAST_SHARE = 0.02, 1e-6
_FIRST_DAMPING = 1e-8
# The rounds end when the noise settles to this part of it.
_ROUNDS, _SETTLED = 8, 0.01

_Normal = TypeVar("_Normal")
_Step = TypeVar("_Step")


class Adjustable(Protocol[_Normal, _Step]):
    """What a minimum is looked for of."""

    def normal(self, state: State, deviation: float) -> tuple[float, _Normal]:
        """Cost and normal equations at a standard deviation of the noise (px)."""

    def step(self, normal: _Normal, damping: float) -> _Step:
        """Their solution, the diagonal multiplied by 1 + damping; or raises Undetermined."""

    def moved(self, state: State, normal: _Normal, step: _Step) -> State:
        """The state after a step."""

    def noise(self, state: State, deviation: float) -> float:
        """Standard deviation of the noise (px), from errors that the last one lets count."""


def minimise(
    problem: Adjustable[_Normal, _Step], state: State, deviation: float, steps: int = _STEPS
) -> State:
    """The state of least cost near to this one, after at most so many steps."""
    cost, normal = problem.normal(state, deviation)
    damping = _FIRST_DAMPING
    for _ in range(steps):
        for _ in range(_MOST_DAMPINGS):
            try:
                trial = problem.moved(state, normal, problem.step(normal, damping))
                trial_cost, trial_normal = problem.normal(trial, deviation)
            except Undetermined:  # far from the minimum, rounding may cost definiteness
                trial_cost = np.inf
            if trial_cost < cost + _LEAST_GAIN:  # NaN compares false
                break
            damping = max(100.0 * damping, 1e-4)
        else:
            return state
        gain = cost - trial_cost
        state, cost, normal, damping = trial, trial_cost, trial_normal, 0.1 * damping
        if gain < max(_LEAST_GAIN, _LEAST_SHARE * cost):
            break
    return state


def settle(
    problem: Adjustable[_Normal, _Step], state: State, deviation: float
) -> tuple[State, float]:
    """State and noise (px) when neither changes any more."""
    for _ in range(_ROUNDS):
        state = minimise(problem, state, deviation)
        before, deviation = deviation, problem.noise(state, deviation)
        if abs(deviation - before) < _SETTLED * deviation:
            break
    return state, deviation
