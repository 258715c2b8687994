# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of rigs against their bounds: ``python -m benchmarks.rigs``.

Single frames of the independent simulator. The bound is the inverse of the Fisher information of
the same points at the true motion, by differences of the simulator's own pixels: of pose and
velocities alone, and of accelerations, too, with the priors that a localizer has by default. Errors
are compared with the latter. Lenses are exact, and the localizer knows it.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
from scipy.stats import chi2

import rs_localizer as rsl
from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.motions import IntArray, Moving, steady
from benchmarks.independent.rigs import Mounted, Scene, Views, middle_of, noisy_frames, views
from benchmarks.independent.rotations import Array, exponential, logarithm
from rs_localizer.config import CalibrationErrors

_CAMERA = Camera(focal=450.0)
_POINTS = 152  # of all cameras
_EXACT = rsl.LocalizerConfig(calibration=CalibrationErrors(0.0, 0.0, 0.0, 0.0))
_UPRIGHT, _TURNED = np.eye(3), np.diag([-1.0, -1.0, 1.0])
_ASIDE = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_REGION = float(chi2.ppf(0.95, 6))
_STEP = 1e-4  # rad, m, and these per second; per second squared a hundred times as much
_UNITS = np.array([math.degrees(1.0), 1e3, math.degrees(1.0), 1.0])


def _at(rotation: Array, centre: tuple[float, float, float]) -> Mounted:
    return Mounted(_CAMERA, rotation, -rotation @ np.array(centre))


def _around(degrees: float) -> Mounted:
    """A camera that looks outwards, 5 cm from the middle."""
    turned = exponential(np.array([0.0, -math.radians(degrees), 0.0]))
    return Mounted(_CAMERA, turned, np.array([0.0, 0.0, -0.05]))


RIGS: dict[str, dict[str, Mounted]] = {
    "one camera": {"a": _at(_UPRIGHT, (0.0, 0.0, 0.0))},
    "two alike": {"a": _at(_UPRIGHT, (-0.05, 0.0, 0.0)), "b": _at(_UPRIGHT, (0.05, 0.0, 0.0))},
    "two opposed": {"a": _at(_UPRIGHT, (-0.05, 0.0, 0.0)), "b": _at(_TURNED, (0.05, 0.0, 0.0))},
    "opposed, 2 mm apart": {
        "a": _at(_UPRIGHT, (-0.001, 0.0, 0.0)),
        "b": _at(_TURNED, (0.001, 0.0, 0.0)),
    },
    "one turned by 90 deg": {
        "a": _at(_UPRIGHT, (-0.05, 0.0, 0.0)),
        "b": _at(_ASIDE, (0.05, 0.0, 0.0)),
    },
    "back to back": {"a": _around(0.0), "b": _around(180.0)},
    "four around": {str(angle): _around(angle) for angle in (0.0, 90.0, 180.0, 270.0)},
}
_BEFORE_WALLS = tuple(RIGS)[:5]


@dataclass(frozen=True, slots=True, eq=False)
class _Model:
    """Model B of f frames about their middle, s; parameters (f,18) as those of a step, per s."""

    rotation: Array  # (f,3,3) map_from_body
    position: Array  # (f,3)
    parameters: Array
    middle: float

    def poses(self, which: IntArray, time: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and positions (n,3) of bodies (n,) at times (n,)."""
        since, own = (time - self.middle)[:, None], self.parameters[which]
        turn, move, rate, speed, change, push = (own[:, k : k + 3] for k in range(0, 18, 3))
        first = self.rotation[which] @ exponential(turn)
        there = self.position[which] + np.einsum("nij,nj->ni", self.rotation[which], move)
        displacement = since * speed + 0.5 * since**2 * push
        return (
            first @ exponential(since * rate + 0.5 * since**2 * change),
            there + np.einsum("nij,nj->ni", first, displacement),
        )


def information(
    mounted: Mapping[str, Mounted], motions: Moving, seen: Mapping[str, Views], noise: float,
    share: float,
) -> Array:  # fmt: skip
    """Fisher information (f,18,18) of pose, velocities and accelerations in SI.

    Args:
        share: of the points that are no outliers.
    """
    count, middle = len(next(iter(seen.values())).points), middle_of(mounted)
    states = motions.states(np.arange(count), np.full(count, middle))
    base = np.zeros((count, 18))
    base[:, 6:9], base[:, 9:12] = states.angular, states.linear
    total = np.zeros((count, 18, 18))
    steps = np.repeat([_STEP, 100.0 * _STEP], (12, 6))
    for name, view in seen.items():
        columns = []
        for k, step in enumerate(steps):
            moved = []
            for sign in (1.0, -1.0):
                parameters = base.copy()
                parameters[:, k] += sign * step
                model = _Model(states.rotation, states.position, parameters, middle)
                view_at = partial(mounted[name].seen, model)  # type: ignore[arg-type]
                moved.append(view_at(np.arange(count), np.zeros(count), view.points))
            columns.append((moved[0] - moved[1]) / (2.0 * step))
        derivatives = np.stack(columns, axis=-1)  # (f,n,2,18)
        derivatives[~view.visible] = 0.0
        total += share / noise**2 * np.einsum("fnak,fnal->fkl", derivatives, derivatives)
    return total


def _prior() -> Array:
    """Information (18,18) that a localizer has of velocities and accelerations."""
    config = rsl.LocalizerConfig()
    speed, change = config.velocity_prior, config.acceleration
    deviations = np.repeat([speed.angular, speed.linear, change.angular, change.linear], 3)
    return np.diag(np.concatenate([np.zeros(6), deviations**-2.0]))


def _spreads(covariances: Array) -> Array:
    """Root of the trace (f,4) of orientation, position and velocities."""
    diagonal = np.einsum("fkk->fk", covariances)[:, :12]
    roots: Array = np.sqrt(diagonal.reshape(-1, 4, 3).sum(axis=2))
    return roots


def _rig(mounted: Mapping[str, Mounted]) -> rsl.Rig:
    places = {name: (each.rotation, each.translation) for name, each in mounted.items()}
    return rsl.Rig(dict.fromkeys(mounted, believed(_CAMERA)), places)


def run(name: str, scene: Scene, noise: float, outliers: float, frames: int, seed: int) -> str:
    """A line of the table."""
    mounted, rng = RIGS[name], np.random.default_rng(seed)
    motions = steady(frames, rng, 1.2, 0.5)
    each = _POINTS // len(mounted)
    seen = views(mounted, motions, np.zeros(frames), each, scene, rng)
    info = information(mounted, motions, seen, noise, 1.0 - outliers)
    plain = _spreads(np.asarray(np.linalg.pinv(info[:, :12, :12], rcond=1e-14, hermitian=True)))
    bound = _spreads(np.asarray(np.linalg.inv(info + _prior())))
    middle, localizer = middle_of(mounted), rsl.Localizer(_rig(mounted), _EXACT)
    states = motions.states(np.arange(frames), np.full(frames, middle))
    ratios, inside, reasons, seconds = [], [], Counter[str](), 0.0
    for frame, parts in enumerate(noisy_frames(seen, noise, outliers, rng)):
        start = time.thread_time()
        result = localizer.localize(parts)
        seconds += time.thread_time() - start
        if not result:
            reasons[str(result.reason)] += 1
            continue
        assert isinstance(result, rsl.RigEstimate)
        error = np.concatenate([
            logarithm(result.rotation @ states.rotation[frame]),
            result.rotation @ (states.position[frame] - result.position),
            states.angular[frame] - result.angular_velocity / result.span,
            states.linear[frame] - result.linear_velocity / result.span,
        ])  # fmt: skip
        ratios.append(np.linalg.norm(error.reshape(4, 3), axis=1) / bound[frame])
        scale = np.repeat([1.0, 1.0, result.span, result.span], 3)
        covariance = result.covariance / np.outer(scale, scale)
        inside.append([
            error[part] @ np.linalg.solve(covariance[part, part], error[part]) < _REGION
            for part in (slice(0, 6), slice(6, 12))
        ])  # fmt: skip
    rms = np.sqrt(np.mean(np.square(ratios), axis=0))
    held = 100.0 * np.mean(inside, axis=0)
    figures = " ".join(f"{value:.3g}" for value in np.median(plain, axis=0) * _UNITS)
    refused = ", ".join(f"{count} {reason}" for reason, count in reasons.items()) or "0"
    return (
        f"| {name} | {scene} | {noise:g} | {outliers:.0%} | "
        f"{figures} | {' '.join(f'{ratio:.2f}' for ratio in rms)} | "
        f"{held[0]:.0f}, {held[1]:.0f} | {refused} | {1e3 * seconds / frames:.1f} |"
    )


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rigs", description="Poses of rigs against their bounds."
    )
    parser.add_argument("--frames", type=int, default=100, help="of each line")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    print(
        "| rig | scene | px | outliers | bound: deg, mm, deg/s, m/s | errors / bound with "
        "the priors | inside: pose, twist (%) | refused | ms |\n" + "|---" * 9 + "|"
    )
    for noise, outliers, scene, name in product((0.3, 1.0), (0.0, 0.2, 0.4), Scene, RIGS):
        if scene == Scene.RICH or name in _BEFORE_WALLS:
            of = (options.frames, options.seed)
            print(run(name, scene, noise, outliers, *of), flush=True)


if __name__ == "__main__":
    main()
