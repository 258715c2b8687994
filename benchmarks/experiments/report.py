# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results on disk: CSV, PNG, and a summary of all claims for people (md) and programs (json)."""

from __future__ import annotations

import csv
import json
import textwrap
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import asdict
from pathlib import Path

from benchmarks.experiments.choosing import choosing_section
from benchmarks.experiments.results import Claim, Result, Table, Verdict

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
