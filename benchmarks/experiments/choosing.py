# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Which solver to choose: one table from several experiments."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from benchmarks.experiments import methods as m
from benchmarks.experiments.results import Result, Table
from benchmarks.experiments.trials import POINTS
from rs_localizer.solvers.table import find_solver

# In the form in which a user gets them.
_METHODS = (m.P3P, m.R6P, m.VC_WT, m.VCT_W, m.VCT_WT, m.VCWT_OURS, m.R9P_OURS, m.JOINT)
# Heading, table, place: where nothing moves, without rotation, and in a quick turn.
_PLACES = (
    ("at rest", "motion_noisy", 0.0),
    ("0.3 per frame, no rotation", "translation", 0.3),
    ("15 deg and 0.15 per frame", "motion_noisy", 15.0),
    ("30 deg and 0.3 per frame", "motion_noisy", 30.0),
)
_NEEDED = ("motion", "translation", "timings")


def choosing_section(results: Mapping[str, Result]) -> list[str]:
    """Lines of Markdown; none unless motion, translation and timings have been run."""
    if not all(name in results for name in _NEEDED):
        return []
    tables = {name: table for result in results.values() for name, table in result.tables.items()}
    headings = ["`solver`", "points", "solutions", "us per sample", *(p[0] for p in _PLACES)]
    caption = (
        "Median orientation error in degrees of a minimal sample at 1 px noise, from the true "
        "orientation, after five iterations; time of one iteration. P3P's is the best of all "
        f"triplets of six points. The last row is what the Localizer makes of {POINTS} points."
    )
    lines = [
        "## Choosing a solver",
        "",
        caption,
        "",
        f"| {' | '.join(headings)} |",
        "|" + "---|" * len(headings),
    ]
    for method in m.available(_METHODS):
        solver = find_solver(method.solver)
        cells = [f"`{method.solver}`", str(solver.sample_size), str(solver.solutions),
                 f"{_microseconds(tables['timings'], method.solver):.2f}"]  # fmt: skip
        lines.append(f"| {' | '.join([*cells, *_errors(tables, method.name)])} |")
    lines.append(f"| refined | {POINTS} | 1 | | {' | '.join(_errors(tables, m.REFINED.name))} |")
    return [*lines, ""]


def _microseconds(timings: Table, solver: str) -> float:
    return float(next(row[2] for row in timings.rows if row[:2] == (solver, 1)))


def _errors(tables: Mapping[str, Table], method: str) -> list[str]:
    return [
        f"{next(float(row[4]) for row in tables[table].rows if _matches(row, x, method)):.2f}"
        for _, table, x in _PLACES
    ]


def _matches(row: Sequence[str | float | int], x: float, method: str) -> bool:
    place, name, metric = row[:3]
    return abs(float(place) - x) < 1e-9 and (name, metric) == (method, "orientation_deg")
