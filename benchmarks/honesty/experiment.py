# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""All benches as one experiment, with a verdict on every claim."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from benchmarks.experiments.results import Claim, Context, Result, Table
from benchmarks.honesty import claims, text
from benchmarks.honesty.benches import Bench, Recordings, benches

_MOST_FRAMES = 100  # of a condition
_JUDGE: Mapping[str, Callable[[Mapping[str, Any]], list[Claim]]] = {
    "p3p": claims.p3p_claims,
    "tags": claims.tag_claims,
    "rendered": claims.rendered_claims,
}


def run(context: Context) -> Result:
    """The experiment."""
    frames = min(context.trials, _MOST_FRAMES)
    judged: list[Claim] = []
    tables: dict[str, Table] = {}
    with tempfile.TemporaryDirectory() as folder:
        recordings = Recordings(
            context.tags,
            {"tum_vi_room5": context.hand_motion, "tum_rgbd_fr1_xyz": context.slow_hand_motion},
            Path(folder),
        )
        all_of_them = benches(recordings)
        for name, judge in _JUDGE.items():
            bench = all_of_them[name]
            found = _run(bench, context, frames)
            judged += judge(found)
            rows = [bench.row(condition, one) for condition, one in found.items()]
            tables[f"honesty_{name}"] = Table(bench.columns, rows)
    return Result(
        "Honesty",
        f"Defaults, {frames} frames of each condition: boards and markers with maps and lenses "
        "that are a little off, against P3P, made by a simulator that shares no code with the "
        "estimator (short recordings at 30 Hz, 640x480, a lens with distortion); a recording of a "
        "real global shutter; rendered walls of markers along recorded hands, through detector and "
        "node. Shares in the tables are in %, of the frames with a pose.",
        judged,
        tables,
        notes=[text.table(table.columns, table.rows) for table in tables.values()],
    )


def _run(bench: Bench[Any, Any], context: Context, frames: int) -> dict[str, Any]:
    conditions = bench.conditions
    each = bench.run(conditions, frames, context.seed)
    return dict(context.track(each, len(conditions)))
