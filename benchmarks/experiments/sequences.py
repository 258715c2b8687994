# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Inliers of plain RANSAC with each solver on a real phone: the paper's Fig. 6."""

from collections.abc import Mapping

import numpy as np

from benchmarks.data import PHONE, PHONE_GYROSCOPE
from benchmarks.experiments import methods as m
from benchmarks.experiments.methods import Method
from benchmarks.experiments.results import Context, Result, Table, limited
from benchmarks.real.gyroscopes import Gyroscope
from benchmarks.real.recordings import Frame, Recording, read_bag
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.settings import build, load_params_file
from rs_localizer.solvers.minimal import solve_minimal
from rs_localizer.solvers.table import find_solver

_ITERATIONS = 1000  # of RANSAC, as in the paper
_THRESHOLD = 2.0  # px of an inlier, as in the paper for its phone
_WITHIN = (1.0, 2.0)  # px, in the table
_FASTEST = 12  # images
_PART = 50  # models that are scored at once
_METHODS = (m.P3P, m.R6P, m.VC_WT, m.VCT_W, m.VCT_WT, m.VCWT, m.R9P, m.R9P_OURS)


def run(context: Context) -> Result:
    """Plain RANSAC on the bundled *real* phone, its images of 330 points.

    Inliers lie within 2 px of the model of the best sample without any optimization, moved as a
    rigid body. The rolling-shutter solvers start from the best orientation of P3P's samples; five
    iterations.
    """
    recording, fastest = _read()
    frames = recording.frames
    # Fewer trials leave slow images out, every one of the fastest stays.
    wanted = int(np.clip(len(frames) * context.trials / 1000, _FASTEST, len(frames)))
    others = np.setdiff1d(np.arange(len(frames)), fastest)
    places = np.sort(np.concatenate([fastest, others[: wanted - _FASTEST]]))
    shares: dict[str, list[tuple[float, ...]]] = {method.name: [] for method in _METHODS}
    for k in context.track(places.tolist(), len(places)):
        rng = np.random.default_rng([context.seed, k])
        for name, share in inliers(recording.camera, frames[k], rng, _METHODS).items():
            shares[name].append(share)
    found = {name: np.array(of) for name, of in shares.items()}
    fast = np.isin(places, fastest)
    mean = {name: of[fast].mean(axis=0) for name, of in found.items()}
    best = max(mean[x.name][1] for x in (m.R6P, *m.TWO_STEP, m.VCWT))
    return Result(
        [
            limited(
                "sequences.vcwt_equals_r6p", "paper: r6p_vcwt finds as many inliers as r6p",
                f"difference of the shares within {_THRESHOLD:g} px, fastest {_FASTEST} images",
                abs(float(mean[m.VCWT.name][1] - mean[m.R6P.name][1])), most=0.02,
            ),
            limited(
                "sequences.beat_p3p", "paper: the six-point solvers find more than P3P",
                f"shares within {_WITHIN[0]:g} px over those of P3P, fastest {_FASTEST} images",
                [mean[x.name][0] / mean[m.P3P.name][0] for x in (m.R6P, *m.TWO_STEP, m.VCWT)],
                least=1.05,
            ),
            limited(
                "sequences.r9p_best", "paper: R9P finds most on the hardest sequences",
                f"its share within {_THRESHOLD:g} px over the best of the six-point solvers",
                float(mean[m.R9P.name][1] / best), least=1.0,
                why="its free matrix follows the noise of nine points; a camera is a rigid body, "
                "and moves as one over the other points. The share counts those",
            ),
        ],
        [_shown(found, fast)],
    )  # fmt: skip


def inliers(
    camera: Camera, frame: Frame, rng: np.random.Generator, methods: tuple[Method, ...]
) -> Mapping[str, tuple[float, ...]]:
    """Shares of the points within some px of the best sample's model, of each method.

    The first of the methods is P3P, whose orientation starts the others.
    """
    centred = frame.points - frame.points.mean(axis=0)
    rays, tau = camera.rays(frame.pixels), camera.row_time(frame.pixels)
    initial, shares = np.eye(3), {}
    for method in methods:
        size = find_solver(method.solver).sample_size
        picks = np.array([rng.choice(len(tau), size, replace=False) for _ in range(_ITERATIONS)])
        solutions = solve_minimal(
            method.solver, centred[picks], rays[picks], tau[picks], initial, method.iterations,
            method.as_published,
        )  # fmt: skip
        models = [np.reshape(x, (-1, *x.shape[2:])) for x in solutions]
        there = np.isfinite(models[0]).all(axis=(1, 2))
        errors, rotation = _best([x[there] for x in models], camera, centred, tau, frame.pixels)
        shares[method.name] = tuple(float(np.mean(errors < px)) for px in _WITHIN)
        if method is methods[0]:
            initial = rotation
    return shares


def _best(
    models: list[Array], camera: Camera, points: Array, tau: Array, pixels: Array
) -> tuple[Array, Array]:
    """Errors (n,), px, of the model with most inliers, and its rotation."""
    best, errors, rotation = -1, np.full(len(tau), np.inf), np.eye(3)
    for start in range(0, len(models[0]), _PART):
        turn, c, w, t = (x[start : start + _PART] for x in models)
        local = np.einsum("mij,nj->mni", turn, points)
        turned = so3.exp_many((tau[None, :, None] * w[:, None]).reshape(-1, 3))
        local = np.einsum("kij,kj->ki", turned, local.reshape(-1, 3)).reshape(local.shape)
        local += c[:, None] + tau[None, :, None] * t[:, None]
        shown = camera.project(local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
        off = np.linalg.norm(shown - pixels, axis=2)
        off[~(local[..., 2] > 0.0) | np.isnan(off)] = np.inf
        counts = np.count_nonzero(off < _THRESHOLD, axis=1)
        k = int(np.argmax(counts))
        if counts[k] > best:
            best, errors, rotation = int(counts[k]), off[k], turn[k]
    return errors, rotation


def _read() -> tuple[Recording, IntArray]:
    """The images, and the places of the fastest."""
    recording = read_bag(PHONE, build(load_params_file(PHONE / "parameters.yaml")))
    times = 1e-9 * np.array([frame.middle_ns for frame in recording.frames])
    half = 0.5 * recording.camera.readout_time
    rates = Gyroscope.read(PHONE_GYROSCOPE).mean_rate(times - half, times + half)
    order = np.argsort(-np.linalg.norm(rates, axis=1)).astype(np.int64)
    return recording, order[:_FASTEST]


def _shown(found: Mapping[str, Array], fast: BoolArray) -> str:
    rows = [
        (name, *(f"{x:.3f}" for x in (*of[fast].mean(axis=0), *of.mean(axis=0))))
        for name, of in found.items()
    ]
    fastest, every = f"fastest {_FASTEST}", f"all {len(fast)}"
    heading = [f"{which}, {px:g} px" for which in (fastest, every) for px in _WITHIN]
    return Table(("Fig. 6: share of the points", *heading), rows).text()
