"""The work of one frame, to be timed: 200 points, half of them wrong."""

from __future__ import annotations

import numpy as np

from benchmarks.experiments.competitors import robust_subjects
from benchmarks.experiments.plain_ransac import observe
from benchmarks.experiments.stopwatch import Subject
from benchmarks.experiments.trials import Setting, camera, draw_trials
from rs_localizer.config import LocalizerConfig
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.estimation.assumptions import assumptions
from rs_localizer.estimation.observations import Observations
from rs_localizer.estimation.ransac import NOTHING, Draws, Hypotheses, search
from rs_localizer.estimation.refine import EXPECTED_NOISE
from rs_localizer.estimation.sampling import Pool, generator
from rs_localizer.localizer import Localizer
from rs_localizer.solvers.table import find_solver

FRAME = Setting(angular=17.0, linear=0.3, noise=0.5, points=200)
OUTLIERS = 0.5
_STILL_FRAME = Setting(noise=0.5, points=200)
_BLOCK = 64
_HYPOTHESES = 1000
ALL_SAMPLES = f"robust loop, {_HYPOTHESES} samples, moving"


def frame_subjects(seed: int) -> dict[str, Subject]:
    """Ours and the competitors' on a frame in motion and on one at rest."""
    subjects: dict[str, Subject] = {}
    view = camera()
    for label, setting in (("moving", FRAME), ("at rest", _STILL_FRAME)):
        points, pixels = _frame(setting, view, seed)
        subjects |= _our_frame_subjects(view, points, pixels, label)
        subjects |= robust_subjects(view, points, pixels, label)
    return subjects


def _frame(setting: Setting, view: Camera, seed: int) -> tuple[Array, Array]:
    """Points and pixels of one frame, half of them wrong."""
    trials = draw_trials(1, seed, setting)
    pixels = trials.rays[0] * view.K[0, 0] + view.K[:2, 2]
    rng = np.random.default_rng(seed)
    wrong = rng.permutation(len(pixels))[: round(OUTLIERS * len(pixels))]
    pixels[wrong] = rng.uniform(-0.5, np.array(view.size) - 0.5, (len(wrong), 2))
    return np.ascontiguousarray(trials.points[0]), pixels


def _our_frame_subjects(
    view: Camera, points: Array, pixels: Array, label: str
) -> dict[str, Subject]:
    localizer = Localizer(view)
    observations = observe(view, points, pixels)
    start = localizer.localize(points, pixels)
    rotation = start.rotation if start else np.eye(3)
    return {
        f"Localizer.localize, {label}": Subject(lambda: localizer.localize(points, pixels), 1),
        f"robust loop, {_HYPOTHESES} samples, {label}": Subject(
            lambda: _all_samples(observations, rotation, localizer.config), 1
        ),
    }


def _all_samples(observations: Observations, rotation: Array, config: LocalizerConfig) -> None:
    """The robust loop with every sample drawn: solving, scoring, local optimisation."""
    solver = find_solver(config.solver)

    def solve(
        points: Array, rays: Array, tau: Array, samples: IntArray, rotations: Array, models: Array
    ) -> None:
        solver.solve(points, rays, tau, samples, rotations, config.solver_iterations, models)

    threshold = config.inlier_threshold
    terms, _ = assumptions(camera(), config, solver)
    never_sure = 1.0
    search(
        observations,
        Hypotheses(
            solve, solver.sample_size, solver.solutions, _BLOCK, 4.0 * threshold, threshold,
            terms, EXPECTED_NOISE * threshold,
        ),
        Draws(
            [rotation], [Pool(np.arange(len(observations)))], never_sure, _HYPOTHESES,
            generator(config.seed),
        ),
        NOTHING,
    )  # fmt: skip
