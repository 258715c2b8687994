# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer evaluate``: errors of estimated poses and twists against the truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rs_localizer.cli import write_all
from rs_localizer.cli.options import argument, option
from rs_localizer.cli.recording_input import remapped
from rs_localizer.io.trajectories import Trajectory, read_motions
from rs_localizer.offline.tasks import Figures
from rs_localizer.tools import errors

_TOPICS = ("pose", "twist", "truth_pose", "truth_twist")


@dataclass(frozen=True, kw_only=True)
class Options:
    estimate: Path = argument("TUM text, a directory of replay, or a recording", "EST")
    truth: Path = argument("likewise", "TRUTH")
    remaps: list[str] = option(
        f"a topic of recordings, NAME one of {', '.join(_TOPICS)}; may be repeated (default: the "
        "only one of its type)", "NAME:=TOPIC", list, flag="-r",
    )  # fmt: skip
    ate: bool = option(
        "also ATE and RPE after alignment, by evo (pip install 'rs_localizer[evaluate]')",
        default=False,
    )
    plot: Path | None = option("draw the errors over time", "FILE.png")


def run(options: Options) -> Figures:
    topics = remapped(options, _TOPICS)
    estimate = read_motions(options.estimate, topics.get("pose"), topics.get("twist"))
    truth = read_motions(options.truth, topics.get("truth_pose"), topics.get("truth_twist"))
    rows, true_rows = errors.associate(estimate.poses.stamps_ns, truth.poses.stamps_ns)
    if len(rows) == 0:
        raise ValueError(
            f"no pose of {options.estimate} is within {1e-9 * errors.TOLERANCE_NS:g} s of one of "
            f"{options.truth}: {_span(estimate.poses)} against {_span(truth.poses)}"
        )
    print(f"{len(rows)} of {len(estimate.poses)} poses compared")
    print(f"{len(np.unique(true_rows))} of {len(truth.poses)} true poses have an estimate")
    found, figures = errors.errors_of(estimate, truth), Figures(poses=len(rows))
    print(f"\n{'error':26}{'count':>6}{'median':>11}{'mean':>11}{'95 %':>11}{'largest':>11}")
    for kind, (_, values) in found.items():
        unit = errors.UNITS[kind]
        known = values if len(values) else np.full(1, np.nan)
        median, p95, largest = np.percentile(known, [50, 95, 100]).tolist()
        columns = "".join(f"{x:11.5f}" for x in (median, float(np.mean(known)), p95, largest))
        print(f"{f'{kind} ({unit})':26}{len(values):6}{columns}")
        name, suffix = kind.replace(" ", "_"), unit.replace("/", "_per_")
        figures |= {f"{name}_median_{suffix}": median, f"{name}_p95_{suffix}": p95}
    if options.ate:
        for name, value in errors.by_evo(estimate.poses, truth.poses).items():
            print(f"{name:34}{value:11.5f}")
            figures[f"{name[:3].lower()}_{name.split('(')[1].split()[0]}"] = value
    if options.plot is not None:
        write_all({options.plot: lambda part: errors.draw({"estimate": found}, part)})
    return figures


def _span(poses: Trajectory) -> str:
    first, last = poses.stamps_ns[[0, -1]] * 1e-9
    return f"{first:.3f} to {last:.3f} s"
