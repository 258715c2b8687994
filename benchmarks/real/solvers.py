# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real solvers RECORDING``: the paper's real experiment on a recording.

Of each solver: points within a pixel and median error of the best of 1000 minimal models, as the
paper counts them, and of the estimate that the Localizer makes with it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks.experiments import methods as m
from benchmarks.experiments.plain_ransac import Best, PlainRansac
from benchmarks.real.peers import PEERS
from benchmarks.real.recordings import Frame, Recording, add_settings, read_bag
from rs_localizer.cli.settings_args import given_settings
from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.localizer import Localizer

_SAMPLES, _THRESHOLD, _NEAR = 1000, 2.0, 1.0  # of the paper; px

Errors = list[Array]
"""Of each image: errors of its points, px; infinite without a pose."""


def minimal(recording: Recording, frames: Sequence[Frame]) -> dict[str, Errors]:
    """The best minimal model of each solver."""
    found: dict[str, Errors] = {method.solver: [] for method in m.PAPERS}
    for seed, frame in enumerate(frames):
        search = PlainRansac.of(
            recording.camera, frame.points, frame.pixels, _SAMPLES, _THRESHOLD, seed
        )
        start = search.best(m.P3P)
        for method in m.PAPERS:
            best = start if method is m.P3P else search.best(method, start.rotation)
            found[method.solver].append(_errors(recording.camera, frame, best))
    return found


def _errors(camera: Camera, frame: Frame, best: Best) -> Array:
    usable: BoolArray = np.asarray(np.isfinite(camera.rays(frame.pixels)).all(axis=1))
    if best.poses_at is None:
        return np.full(len(usable), np.inf)
    points, pixels = frame.points[usable], frame.pixels[usable]
    turns, moves = best.poses_at(camera.row_time(pixels))
    shown = camera.project(np.einsum("nij,nj->ni", turns, points - points.mean(axis=0)) + moves)
    errors = np.full(len(usable), np.inf)
    errors[usable] = np.nan_to_num(np.linalg.norm(shown - pixels, axis=1), nan=np.inf)
    return errors


def refined(
    recording: Recording, frames: Sequence[Frame], config: LocalizerConfig, solver: str
) -> Errors:
    """The estimates of each image alone."""
    localizer = Localizer(recording.camera, replace(config, solver=solver))
    found = []
    for frame in frames:
        result = localizer.localize(frame.points, frame.pixels)
        errors = result.residuals if result else np.full(len(frame.points), np.inf)
        found.append(np.nan_to_num(np.asarray(errors), nan=np.inf))
    return found


def peer(recording: Recording, frames: Sequence[Frame], name: str) -> Errors:
    """The poses of a peer."""
    found = []
    for frame in frames:
        pose = PEERS[name](recording.camera, frame.points, frame.pixels)
        found.append(pose.residuals if pose else np.full(len(frame.points), np.inf))
    return found


def _cells(errors: Errors) -> str:
    near = np.mean([np.mean(of_image < _NEAR) for of_image in errors])
    median = np.median([np.median(of_image) for of_image in errors])
    return f"{near:.3f} | {median:.2f}"


def text(before: dict[str, Errors], after: dict[str, Errors], peers: dict[str, Errors]) -> str:
    """The table."""
    lines = [
        "| `solver` | minimal: within 1 px | median (px) | estimate: within 1 px | median (px) |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| `{name}` | {_cells(errors)} | {_cells(after[name])} |"
        for name, errors in before.items()
    ]
    lines += [f"| {name} | | | {_cells(errors)} |" for name, errors in peers.items()]
    return "\n".join(lines)


def main(argv: Sequence[str]) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real solvers", description=__doc__)
    parser.add_argument("recording", type=Path, help="a bag")
    parser.add_argument("--every", type=int, default=1, help="one image in so many")
    parser.add_argument("--out", type=Path, default=Path("real"), help="table")
    add_settings(parser)
    args = parser.parse_args(argv)
    config = given_settings(args)
    recording = read_bag(args.recording, config)
    frames = recording.frames[:: args.every]
    before = minimal(recording, frames)
    after = {name: refined(recording, frames, config, name) for name in before}
    table = text(before, after, {name: peer(recording, frames, name) for name in PEERS})
    print(table)
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "solvers.md").write_text(table + "\n", encoding="utf-8")
