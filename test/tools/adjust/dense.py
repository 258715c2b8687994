# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The adjustment's terms as dense matrices, and their derivatives by differences."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.system import Groups, Quadratic, Rows
from rs_localizer.tools.adjust.variables import Unknowns


def unknowns(groups: Groups) -> int:
    return groups.kept + groups.blocks * groups.width


def jacobian(rows: Rows, count: int) -> np.ndarray:
    """Derivatives (n,r,count) of rows by all unknowns."""
    run = rows.values.shape[2] - rows.others.shape[1]
    whole = np.zeros((*rows.values.shape[:2], count))
    for n, (first, others) in enumerate(zip(rows.first, rows.others, strict=True)):
        whole[n, :, first : first + run] += rows.values[n, :, :run]
        for k, column in enumerate(others):
            if column >= 0:
                whole[n, :, column] += rows.values[n, :, run + k]
    return whole


def normal_of(groups: Groups, terms: Sequence[Rows | Quadratic]) -> tuple[np.ndarray, np.ndarray]:
    count = unknowns(groups)
    matrix, slope = np.zeros((count, count)), np.zeros(count)
    for term in terms:
        if isinstance(term, Quadratic):
            matrix[np.ix_(term.columns, term.columns)] += term.information
            slope[term.columns] += term.slope
            continue
        rows = jacobian(term, count).reshape(-1, count)
        matrix += rows.T @ rows
        slope += rows.T @ term.errors.ravel()
    return matrix, slope


def are_derivatives(
    rows_of: Callable[[Unknowns], Rows], problem: Problem, state: Unknowns, step: float = 1e-6
) -> None:
    """Assert that the values of rows are the derivatives of their errors by each unknown."""
    count = unknowns(problem.groups)
    expected = jacobian(rows_of(state), count)
    assert np.any(expected)
    for k in range(count):
        change = step * np.eye(count)[k]
        more, less = (rows_of(problem.moved(state, s * change)).errors for s in (1.0, -1.0))
        scale = np.abs(expected[..., k]).max() + np.abs(expected).max() * 1e-3
        np.testing.assert_allclose(
            (more - less) / (2.0 * step), expected[..., k], atol=1e-5 * max(scale, 1e-3)
        )


def fitting(problem: Problem, state: Unknowns) -> Problem:
    """Of pixels without errors: whitening, and so its derivative, counts for nothing."""
    views = [
        replace(view, observations=replace(
            view.observations, pixels=view.observations.pixels + seen.errors
        ))
        for view, seen in zip(problem.views, problem.sights(state), strict=True)
    ]  # fmt: skip
    return Problem(views, state, deviations=problem.deviations, floating=bool(problem.floating))
