# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether minimal solvers for a known turn rate or a known vertical are worth having.

The robust loop of the localizer with other solvers in it, on bearings that the gyroscope has turned
row by row, and then the localizer's own refinement; not its acceptance, which refuses poses of so
few points whoever proposes them.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from benchmarks.experiments.results import Claim, Context, Statement, Table
from benchmarks.honesty.estimating import believed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import MakeMotions
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import hand, shaken_hand
from benchmarks.independent.scenes import Rich
from benchmarks.inertial.linear_solvers import linear_solver
from benchmarks.inertial.recordings import Recorded, record, turn_of_frame
from benchmarks.inertial.single import US, Step
from rs_localizer.config import LocalizerConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera as Believed
from rs_localizer.core.gyro_rotation import GyroRotation
from rs_localizer.core.rig import Rig
from rs_localizer.estimation.observations import Observed, Sighted, find_usable, packed
from rs_localizer.estimation.posterior import maximum_a_posteriori
from rs_localizer.estimation.prior import Prior, assumptions, of_frame
from rs_localizer.estimation.ransac import generator
from rs_localizer.estimation.searching import MotionSearch
from rs_localizer.solvers.table import Solver, find_solver, start_solver

_FEW = (6, 8, 12)  # right matches, and as many wrong ones
_SHAKING = ((0.3, 60.0), (0.1, 120.0))  # degrees, hertz
_TILT = math.radians(1.0)  # standard deviation of the direction of gravity
_RIGHT = math.radians(1.0)
# Of a difference of two shares, for it to count.
_DEVIATIONS = 2.0
_DOWN = np.array([0.0, 0.0, -1.0])  # in the map


@dataclass(frozen=True, slots=True)
class Entry:
    """A solver in the loop, and what it and the refinement know beside the points."""

    name: str
    solver: Callable[[Array], Solver]  # of the direction (3,) of gravity in the camera
    turn: bool
    vertical: bool
    special: bool = False  # one that we do not have


def _present(name: str, _: Array) -> Solver:
    return replace(find_solver(name), rolling_shutter=True)


_ENTRIES = (
    Entry("r6p_vcwt, camera alone", partial(_present, "r6p_vcwt"), turn=False, vertical=False),
    Entry("r6p_vcwt", partial(_present, "r6p_vcwt"), turn=True, vertical=False),
    Entry("p3p", partial(_present, "p3p"), turn=True, vertical=False),
    Entry("turn known, 5 points", lambda _: linear_solver(5, turn_known=True),
          turn=True, vertical=False, special=True),
    Entry("r6p_vcwt, vertical in the prior", partial(_present, "r6p_vcwt"),
          turn=True, vertical=True),
    Entry("p3p, vertical in the prior", partial(_present, "p3p"), turn=True, vertical=True),
    Entry("turn and vertical known, 4 points",
          lambda down: linear_solver(4, turn_known=True, vertical=(_DOWN, down)),
          turn=True, vertical=True, special=True),
    Entry("vertical known, 5 points, no gyroscope",
          lambda down: linear_solver(5, turn_known=False, vertical=(_DOWN, down)),
          turn=False, vertical=True, special=True),
)  # fmt: skip


def minimal(context: Context) -> Step:
    count = max(10, context.trials // 10)
    rows: list[tuple[str | float, ...]] = []
    claims: list[Claim] = []
    shaken: MakeMotions = partial(shaken_hand, shaking=_SHAKING)
    for motion, make in (("hand", hand), ("shaken", shaken)):
        recorded = record(Camera(), make, Rich(), (count, 1), context.seed, _known_imu())
        for few in _FEW:
            found = {entry: _tried(recorded, entry, few, context.seed) for entry in _ENTRIES}
            rows += [
                (f"{motion}/{few} right of {2 * few}/{entry.name}", *_figures(*results))
                for entry, results in found.items()
            ]
            for vertical in (False, True):
                right = {
                    entry: errors < _RIGHT
                    for entry, (errors, _) in found.items()
                    if entry.turn and entry.vertical == vertical
                }
                claims.append(_judge(f"{motion}-{few}", vertical, right))
    return "minimal", Table(("condition", "frames", "within 1 deg", "deg", "samples"), rows), claims


def _judge(name: str, vertical: bool, right: dict[Entry, BoolArray]) -> Claim:
    known = "turn and vertical" if vertical else "turn"
    special = next(right[entry] for entry in right if entry.special)
    ours = max((right[entry] for entry in right if not entry.special), key=np.mean)
    difference = special.astype(float) - ours
    error = float(np.std(difference)) / math.sqrt(len(difference))
    return Statement(
        f"inertial.minimal-{name}-{'vertical' if vertical else 'turn'}",
        US,
        f"With {known} known, the solvers that are there find as much as one made for it",
        "no fewer frames within 1 deg, beyond chance",
    ).judged(
        f"{100.0 * ours.mean():.0f} %, made for it {100.0 * special.mean():.0f} %",
        float(difference.mean()) <= _DEVIATIONS * error,
    )


def _known_imu() -> Imu:
    return replace(Imu(), bias=0.0)


def _tried(recorded: Recorded, entry: Entry, few: int, seed: int) -> tuple[Array, list[int]]:
    """Errors of the orientation (n,) in rad, and samples drawn, of all frames."""
    camera, frames = believed(recorded.frames.camera), recorded.frames
    rng = np.random.default_rng(seed)
    size = np.array(camera.size) - 1.0
    errors, samples = [], []
    for frame in range(len(frames)):
        points, pixels = frames.seen(frame, 1.0)
        points, pixels = points[: 2 * few], pixels[: 2 * few]
        pixels[few:] = rng.uniform(0.0, size, pixels[few:].shape)
        true = frames.middle.rotation[frame]
        down = true.T @ _DOWN
        down = down + _TILT * rng.normal(size=3)
        down /= np.linalg.norm(down)
        turn = turn_of_frame(recorded, frame, camera.readout_time) if entry.turn else None
        prior = Prior(gravity=down, gravity_deviation=_TILT) if entry.vertical else None
        solver = entry.solver(down)
        rotation, drawn = _found(camera, solver, (points, pixels), turn, prior)
        errors.append(np.linalg.norm(so3.log(np.ascontiguousarray(rotation @ true))))
        samples.append(drawn)
    return np.array(errors), samples


def _found(
    camera: Believed,
    solver: Solver,
    given: tuple[Array, Array],
    turn: GyroRotation | None,
    prior: Prior | None,
) -> tuple[Array, int]:
    """Rotation (3,3) camera_from_map by the robust loop and the refinement."""
    config = LocalizerConfig()
    exposure = Rig.of(camera).exposure()
    terms, assumed = assumptions(camera.readout_time, Rig.of(camera), config, solver)
    terms, assumed, _ = of_frame(terms, assumed, prior, turn)
    usable = find_usable(exposure, *given, [len(given[0])], turn)
    observed = Observed(
        packed(exposure, given[0], usable),
        np.zeros(0, np.int64),
        terms,
        generator(config.seed),
        assumed,
        Sighted(exposure, *given, usable, turn),
    )
    start, best = MotionSearch(camera.focal_length, config, solver, start_solver(solver)).find(
        observed
    )
    if not start.found:
        return np.diag([1.0, -1.0, -1.0]), best.samples
    threshold = config.inlier_threshold
    posterior = maximum_a_posteriori(observed.observations, best.state, observed.terms, threshold)
    return posterior.state[:9].reshape(3, 3), best.samples


def _figures(errors: Array, samples: list[int]) -> tuple[float, ...]:
    right = errors < _RIGHT
    return (
        len(errors),
        100.0 * float(np.mean(right)),
        float(np.degrees(np.median(errors))),
        float(np.median(samples)),
    )
