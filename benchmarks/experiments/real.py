# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Inliers per frame within RANSAC on sequences, with each solver."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from benchmarks.experiments import charts
from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import available
from benchmarks.experiments.plain_ransac import PlainRansac
from benchmarks.experiments.real_claims import METHODS, OURS, Inliers, claims, notes
from benchmarks.experiments.results import Context, Result, Table
from benchmarks.experiments.sequences import Frame, Sequence, action_camera, hard, phone, webcam
from rs_localizer.localizer import Localizer

_SAMPLES = 1000
_MOST_FRAMES, _LEAST_FRAMES = 60, 6
_FRAMES_PER_TRIAL = 0.03


def run(context: Context) -> Result:
    """The experiment."""
    frames = int(np.clip(_FRAMES_PER_TRIAL * context.trials, _LEAST_FRAMES, _MOST_FRAMES))
    sequences = [
        phone(context.hand_motion, frames, context.seed),
        action_camera(context.hand_motion, frames, context.seed),
        hard(frames, context.seed),
        webcam(context.webcam, context.webcam_readout_time, frames),
    ]
    total = sum(len(sequence.frames) for sequence in sequences)
    numbered = [(s, index) for s in sequences for index in range(len(s.frames))]
    counts: dict[str, list[dict[str, int]]] = {s.name: [] for s in sequences}
    for sequence, index in context.track(numbered, total):
        counts[sequence.name].append(
            _inliers(sequence, sequence.frames[index], context.seed + index)
        )
    found = {
        name: {method: np.array([row[method] for row in rows]) for method in rows[0]}
        for name, rows in counts.items()
    }
    return Result(
        "Sequences",
        f"Inliers of the best of {_SAMPLES} minimal models, as the paper counts them, on {frames} "
        "frames of each sequence: no local optimisation, initial orientation from as many "
        "samples of P3P. `localizer` is the product instead, at its defaults and the same "
        "threshold. R9P is scored by its own model, which is no rigid motion. Two sequences are "
        "simulated along the recorded motion of a hand, with 150 points of which 30 % are "
        "outliers; so are the frames of the hardest, each by itself under 30 degrees and 0.3 m "
        "per readout; the last is a recording of a plane, where P3P has nothing to lose.",
        claims(found),
        {
            f"real_{name}": Table(
                ("frame", "method", "inliers"),
                [
                    (frame, method, int(count))
                    for method, values in rows.items()
                    for frame, count in enumerate(values)
                ],
            )
            for name, rows in found.items()
        },
        {f"real_{s.name}": _figure(s, found[s.name]) for s in sequences},
        notes(found["webcam"]),
    )


def _inliers(sequence: Sequence, frame: Frame, seed: int) -> dict[str, int]:
    search = PlainRansac.of(
        sequence.camera, frame.points, frame.pixels, _SAMPLES, sequence.threshold, seed
    )
    start = search.best(m.P3P)
    counts = {m.P3P.name: start.inliers}
    for method in available(METHODS[1:]):
        counts[method.name] = search.best(method, start.rotation).inliers
    localizer = Localizer(sequence.camera, inlier_threshold=sequence.threshold)
    result = localizer.localize(frame.points, frame.pixels)
    counts[OURS] = int(np.count_nonzero(result.inliers)) if result else 0
    return counts


def _figure(sequence: Sequence, rows: Inliers) -> Figure:
    drawn = charts.figure(9.6, 4.6)
    axes = drawn.subplots()
    x = np.arange(len(sequence.frames), dtype=np.float64)
    for method in available(m.PAPERS):
        style = charts.look(method)
        charts.line(axes, x, rows[method.name].astype(float), style, method.label)
    charts.line(axes, x, rows[OURS].astype(float), charts.look(m.REFINED), "ours: the Localizer")
    axes.set_ylim(bottom=0.0)
    axes.set_title(sequence.title)
    charts.tidy(axes, "frame", "inliers")
    charts.legend(drawn, axes)
    return drawn
