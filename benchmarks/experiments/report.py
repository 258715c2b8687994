# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results on disk: CSV, PNG, and a summary of all claims for people (md) and programs (json)."""

from __future__ import annotations

import csv
import json
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

from benchmarks.experiments import methods as m
from benchmarks.experiments.results import Claim, Result, Table, Verdict
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


SUMMARY, SUMMARY_DATA = "summary.md", "summary.json"
_LETTERS_PER_INCH = 10.0  # of a title


def write_result(folder: Path, result: Result) -> None:
    """Tables and figures of one experiment."""
    for name, table in result.tables.items():
        _write_table(folder / f"{name}.csv", table)
    for name, figure in result.figures.items():
        letters = int(_LETTERS_PER_INCH * figure.get_figwidth())
        figure.suptitle(textwrap.fill(result.title, letters))
        figure.savefig(folder / f"{name}.png")
    for name, data in result.files.items():
        (folder / name).write_bytes(data)


def write_summary(
    folder: Path,
    results: Mapping[str, Result],
    seconds: Mapping[str, float],
    trials: int,
    seed: int,
) -> None:
    """Every claim with our figure and its verdict."""
    introduction = (
        f"{trials} trials, seed {seed}, {sum(seconds.values()):.0f} s in all. The paper is "
        "Kukelova, Albl, Sugimoto, Pajdla, *Linear solution to the minimal absolute pose rolling "
        "shutter problem*, ACCV 2018. Verdicts are computed from the tables beside this file."
    )
    lines = [
        "# Experiments",
        "",
        introduction,
        "",
        f"**{count_verdicts(claim for result in results.values() for claim in result.claims)}**",
        "",
    ]
    lines += choosing_section(results)
    for name, result in results.items():
        lines += _section(name, result, seconds[name])
    (folder / SUMMARY).write_text("\n".join(lines), encoding="utf-8")
    data = {
        "trials": trials,
        "seed": seed,
        "seconds": {name: round(value, 1) for name, value in seconds.items()},
        "claims": [asdict(claim) for result in results.values() for claim in result.claims],
    }
    (folder / SUMMARY_DATA).write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def count_verdicts(claims: Iterable[Claim]) -> str:
    """``12 held, 3 did not hold, 1 not tested``."""
    counts = Counter(claim.verdict for claim in claims)
    found = [f"{counts[verdict]} {verdict}" for verdict in Verdict if counts[verdict]]
    return ", ".join(found) or "no claims"


def _section(name: str, result: Result, seconds: float) -> list[str]:
    lines = [f"## {result.title}", "", f"`python -m benchmarks {name}`, {seconds:.0f} s", ""]
    lines += [result.setting, ""]
    lines += ["| claim | source | holds if | our figure | verdict |", "|---|---|---|---|---|"]
    for claim in result.claims:
        cells = (claim.statement, claim.source, claim.criterion, claim.finding)
        plain = [cell.replace("|", "\\|") for cell in cells]
        lines.append(f"| {' | '.join(plain)} | {_emphasized(claim.verdict)} |")
    lines.append("")
    for claim in result.claims:
        if claim.why:
            lines += [f"Why not *{claim.statement}*: {claim.why}.", ""]
    for note in result.notes:
        lines += ["```", note, "```", ""] if "\n" in note else [note, ""]
    for figure in result.figures:
        lines += [f"![{figure}]({figure}.png)", ""]
    for file in result.files:
        lines += [f"![{file}]({file})", ""]
    tables = ", ".join(f"[{table}.csv]({table}.csv)" for table in result.tables)
    return [*lines, f"Data: {tables}", ""]


def _emphasized(verdict: Verdict) -> str:
    return f"**{verdict}**" if verdict is Verdict.NOT_HELD else str(verdict)


def _write_table(path: Path, table: Table) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(table.columns)
        for row in table.rows:
            writer.writerow([f"{x:.6g}" if isinstance(x, float) else x for x in row])
