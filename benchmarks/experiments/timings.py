# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What minimal problems cost, and the first pose; frames: ``python -m benchmarks.frames times``."""

from __future__ import annotations

import importlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from types import ModuleType

import cv2
import numpy as np

from benchmarks.experiments.results import Claim, Context, Result, Statement, Table, Track
from benchmarks.experiments.trials import Setting, Trials, camera, draw_trials
from rs_localizer.core.arrays import Array
from rs_localizer.solvers.batch import MODEL_SIZE
from rs_localizer.solvers.minimal import solve_minimal
from rs_localizer.solvers.table import SOLVERS, find_solver


@dataclass(frozen=True, slots=True)
class Subject:
    """Something to be timed: ``run`` does its work ``count`` times."""

    run: Callable[[], object]
    count: int


def interleaved(subjects: Mapping[str, Subject], repeats: int, track: Track) -> dict[str, Array]:
    """Times (repeats,) per piece of work of each subject, in microseconds.

    All subjects take turns, so that a slow moment of the machine hits all of them alike: compare
    them turn by turn, see :func:`ratio`.
    """
    for subject in subjects.values():
        subject.run()  # compiles, fills caches
    times: dict[str, list[float]] = {name: [] for name in subjects}
    rounds: Iterable[int] = range(repeats)
    for _ in track(rounds, repeats):
        for name, subject in subjects.items():
            start = time.perf_counter()
            subject.run()
            times[name].append(time.perf_counter() - start)
    return {name: 1e6 * np.array(times[name]) / subjects[name].count for name in subjects}


def ratio(one: Array, other: Array) -> float:
    """Median of what one subject took in units of what the other took in the same turn."""
    return float(np.median(one / other))


def poselib() -> ModuleType | None:
    """The module, or None where it is not installed."""
    try:
        return importlib.import_module("poselib")
    except ImportError:
        return None


def p3p_subjects(trials: Trials) -> dict[str, Subject]:
    """P3P on the first three points of each frame, one call per frame."""
    K = camera().K
    triplets = [np.ascontiguousarray(x[:3]) for x in trials.points]
    pixels = [np.ascontiguousarray(r[:3] * K[0, 0] + K[:2, 2]) for r in trials.rays]

    def opencv() -> None:
        for points, seen in zip(triplets, pixels, strict=True):
            cv2.solveP3P(points, seen, K, None, cv2.SOLVEPNP_P3P)

    subjects = {"OpenCV solveP3P": Subject(opencv, len(trials))}
    module = poselib()
    if module is not None:
        bearings = []
        for rays in trials.rays[:, :3]:
            bearing = np.column_stack([rays, np.ones(3)])
            bearings.append(list(bearing / np.linalg.norm(bearing, axis=1, keepdims=True)))
        lists = [list(points) for points in triplets]

        def with_poselib() -> None:
            for bearing, points in zip(bearings, lists, strict=True):
                module.p3p(bearing, points)

        subjects["PoseLib p3p"] = Subject(with_poselib, len(trials))
    return subjects


# Runs in a new interpreter: seconds until the first pose and until every kernel is there, by the
# clock and of the processor.
_SCRIPT = """
import time
start = time.perf_counter()
start_of_work = time.process_time()
import json
import numpy as np
import rs_localizer as rsl
from rs_localizer.solvers.table import SOLVERS, find_solver

def passed():
    return time.perf_counter() - start, time.process_time() - start_of_work

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
rsl.Localizer(rsl.Camera(width=640, height=480, K=K)).warm_up()
first = passed()
rng = np.random.default_rng(0)
for name in SOLVERS:
    n = find_solver(name).sample_size
    sample = rng.normal(size=(1, n, 3)), rng.normal(size=(1, n, 2)), rng.uniform(-0.5, 0.5, (1, n))
    for as_published in (False, True):
        rsl.solve_minimal(name, *sample, as_published=as_published)
print(json.dumps([*first, *passed()]))
"""


@dataclass(frozen=True, slots=True)
class Startup:
    """Seconds since the import. Work: of the processor, which other processes do not lengthen."""

    first_pose: float
    first_pose_work: float
    all_kernels: float
    all_kernels_work: float


def cold_and_warm() -> tuple[Startup, Startup]:
    """A process that finds nothing compiled, and one that finds everything in the cache.

    Raises:
        OSError: a new interpreter could not import or run the package.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ)
        environment["NUMBA_CACHE_DIR"] = cache
        environment["PYTHONPATH"] = os.pathsep.join(sys.path)
        return _measure(environment), _measure(environment)


def _measure(environment: dict[str, str]) -> Startup:
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise OSError(f"a new interpreter could not run the package: {last[0]}")
    return Startup(*json.loads(done.stdout))


_BATCH = 4096
_REFERENCE = "numpy.linalg.solve of 12x12"
_SETTING = Setting(angular=10.0, linear=0.1, noise=0.5)
_REPEATS_PER_TRIAL = 0.02
_FEWEST, _MOST = 5, 41
# Fewer trials than this leave out what takes most of a minute: compiling from nothing.
_TRIALS_FOR_STARTUP = 500


@dataclass(frozen=True, slots=True)
class Budget:
    """A solver to be timed, and what it may cost in units of one 12x12 solve."""

    solver: str
    iterations: int
    at_most: float = np.nan  # NaN: not given
    aim: float = np.nan
    paper_us: float = np.nan  # per iteration, Table 1 of the paper


_BUDGETS = (
    Budget("p3p", 1, 0.30, 0.15, 3.0),
    Budget("r6p_vcwt", 1, 0.20, 0.10, 10.0),
    Budget("r6p_vcwt", 5, 0.60, 0.40, 10.0),
    Budget("r6p_vct_w", 1, 0.45, 0.25, 24.0),
    Budget("r6p_vct_wt", 1, 0.45, 0.25, 30.0),
    Budget("r6p_vc_wt", 1, 0.45, 0.25, 27.0),
    Budget("r9p", 1, 0.60, 0.35, 20.0),
    Budget("r6p", 1, 14.0, 9.0, 1700.0),
)
_COMPILE_AT_MOST, _FIRST_POSE_AT_MOST = 40.0, 1.5  # s


def run(context: Context) -> Result:
    """The experiment."""
    repeats = int(np.clip(_REPEATS_PER_TRIAL * context.trials, _FEWEST, _MOST))
    unlimited = SOLVERS.keys() - {budget.solver for budget in _BUDGETS}
    budgets = [*_BUDGETS, *(Budget(name, 1) for name in SOLVERS if name in unlimited)]
    minimal = interleaved(_minimal_subjects(budgets, context.seed), repeats, context.track)
    startup = None
    if context.trials >= _TRIALS_FOR_STARTUP:
        startup = cold_and_warm()
    rows = [_row(budget, minimal) for budget in budgets]
    claims = [_cost(budget, minimal) for budget in budgets if np.isfinite(budget.at_most)]
    claims.append(_faster_than_paper(rows))
    claims += _startup_claims(startup)
    return Result(
        "Timings",
        f"One core, {repeats} turns that all subjects take in order, because the machine has "
        "other things to do: times are medians, ratios medians over the turns. Minimal problems "
        f"in batches of {_BATCH}: `kernel` is the compiled batch alone, `solve_minimal` the same "
        "with checks and copies of the public function; `/ 12x12` is the kernel in units of one "
        "`numpy.linalg.solve` of a batch of 12x12 systems. OpenCV's and PoseLib's P3P include one "
        "call from Python each. The paper's times are those of its Table 1 (2.5 GHz i7), per "
        "iteration.",
        claims,
        {"timings": Table(_COLUMNS, rows)},
        notes=[_text(rows, minimal, startup)],
    )


_COLUMNS = (
    "solver", "iterations", "kernel_us", "kernel_us_per_iteration", "solve_minimal_us",
    "kernel_per_12x12", "at_most", "aim", "paper_us_per_iteration",
)  # fmt: skip


def _minimal_subjects(budgets: list[Budget], seed: int) -> dict[str, Subject]:
    trials = draw_trials(_BATCH, seed, _SETTING)
    rng = np.random.default_rng(seed)
    matrices, right = rng.normal(size=(_BATCH, 12, 12)), rng.normal(size=(_BATCH, 12, 1))
    subjects = {_REFERENCE: Subject(lambda: np.linalg.solve(matrices, right), _BATCH)}
    for budget in budgets:
        subjects |= _solver_subjects(budget, trials)
    some = draw_trials(_BATCH // 16, seed, _SETTING)
    return subjects | p3p_subjects(some)


def _solver_subjects(budget: Budget, trials: Trials) -> dict[str, Subject]:
    solver = find_solver(budget.solver)
    n = solver.sample_size
    points, rays, tau = (
        np.ascontiguousarray(x[:, :n]) for x in (trials.points, trials.rays, trials.tau)
    )
    samples = np.arange(_BATCH * n, dtype=np.int64).reshape(_BATCH, n)
    models = np.empty((solver.solutions, MODEL_SIZE, _BATCH))
    rotations = trials.truth.rotation

    def kernel() -> None:
        solver.solve(
            points.reshape(-1, 3), rays.reshape(-1, 2), tau.ravel(), samples, rotations,
            budget.iterations, models,
        )  # fmt: skip

    def public() -> None:
        solve_minimal(budget.solver, points, rays, tau, rotations, budget.iterations)

    return {
        _key(budget): Subject(kernel, _BATCH),
        _key(budget) + " solve_minimal": Subject(public, _BATCH),
    }


def _key(budget: Budget) -> str:
    return f"{budget.solver} x{budget.iterations}"


def _row(budget: Budget, times: Mapping[str, Array]) -> tuple[str | float | int, ...]:
    kernel = float(np.median(times[_key(budget)]))
    return (
        budget.solver,
        budget.iterations,
        kernel,
        kernel / budget.iterations,
        float(np.median(times[_key(budget) + " solve_minimal"])),
        ratio(times[_key(budget)], times[_REFERENCE]),
        budget.at_most,
        budget.aim,
        budget.paper_us,
    )


def _cost(budget: Budget, times: Mapping[str, Array]) -> Claim:
    share = ratio(times[_key(budget)], times[_REFERENCE])
    kernel, reference = (float(np.median(times[name])) for name in (_key(budget), _REFERENCE))
    steps = "once" if budget.iterations == 1 else f"{budget.iterations} iterations"
    return Statement(
        f"timings.{budget.solver}_{budget.iterations}",
        "this project",
        f"{budget.solver}, {steps}, costs a fraction of a general 12x12 solve",
        f"kernel at most {budget.at_most:g} of `{_REFERENCE}` (aim {budget.aim:g})",
    ).judged(
        f"{share:.3f} ({kernel:.3f} us of {reference:.2f} us)",
        share <= budget.at_most,
        "the machine had other work, or is of another kind: compare the columns with each other",
    )


def _faster_than_paper(rows: list[tuple[str | float | int, ...]]) -> Claim:
    gains = {
        f"{row[0]} x{row[1]}": float(row[8]) / float(row[3])
        for row in rows
        if np.isfinite(float(row[8]))
    }
    return Statement(
        "timings.faster_than_paper",
        "this project",
        "every solver is faster than in the paper's Table 1",
        "per iteration",
    ).judged(
        ", ".join(f"{name} {gain:.0f} times" for name, gain in gains.items()),
        min(gains.values()) > 1.0,
    )


def _startup_claims(startup: tuple[Startup, Startup] | None) -> list[Claim]:
    if startup is None:
        return []
    cold, warm = startup
    return [
        Statement(
            "timings.compile",
            "this project",
            "all kernels compile soon enough",
            f"import and compilation from nothing take at most {_COMPILE_AT_MOST:g} s of the "
            "processor",
        ).judged(
            f"{cold.all_kernels_work:.1f} s ({cold.all_kernels:.1f} s by the clock)",
            cold.all_kernels_work <= _COMPILE_AT_MOST,
        ),
        Statement(
            "timings.first_pose",
            "this project",
            "with the cache, the first pose comes soon",
            f"import to first pose takes at most {_FIRST_POSE_AT_MOST:g} s of the processor",
        ).judged(
            f"{warm.first_pose_work:.2f} s ({warm.first_pose:.2f} s by the clock)",
            warm.first_pose_work <= _FIRST_POSE_AT_MOST,
        ),
    ]


def _text(
    rows: list[tuple[str | float | int, ...]],
    minimal: Mapping[str, Array],
    startup: tuple[Startup, Startup] | None,
) -> str:
    """The tables as they are printed."""
    headings = (
        ("kernel", 9),
        ("/iteration", 11),
        ("solve_minimal", 14),
        ("/ 12x12", 9),
        ("at most", 9),
        ("paper /iteration", 17),
    )
    lines = [f"{'us per minimal problem':26}" + "".join(f"{h:>{width}}" for h, width in headings)]
    for name, iterations, kernel, per_iteration, public, share, at_most, _, paper in rows:
        lines.append(
            f"{f'{name} x{iterations}':26}{kernel:9.3f}{per_iteration:11.3f}{public:14.3f}"
            f"{share:9.3f}" + (f"{at_most:9.2f}{paper:17.0f}" if np.isfinite(paper) else "")
        )
    others = [name for name in minimal if name in (_REFERENCE, "OpenCV solveP3P", "PoseLib p3p")]
    lines += [
        f"{name:26}{np.median(minimal[name]):9.3f}{'':34}"
        f"{ratio(minimal[name], minimal[_REFERENCE]):9.3f}"
        for name in others
    ]
    if startup is not None:
        cold, warm = startup
        title = "s from import, by the clock (of the processor)"
        lines += ["", f"{title:50}{'from nothing':>18}{'from the cache':>18}"]
        for label, field in (
            ("to the first pose", "first_pose"),
            ("to all kernels of all solvers", "all_kernels"),
        ):
            cells = [
                f"{getattr(x, field):.2f} ({getattr(x, field + '_work'):.2f})" for x in (cold, warm)
            ]
            lines.append(f"{label:50}{cells[0]:>18}{cells[1]:>18}")
    return "\n".join(lines)
