# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Poses of rigs against their bounds: ``python -m benchmarks.rigs``.

Single frames of the independent simulator. The bound is the inverse of the Fisher information of
the same points at the true motion, by differences of the simulator's own pixels: of pose and
velocities alone, and of accelerations, too, with the priors that a localizer has by default. Errors
are compared with the latter. Lenses are exact, and the localizer knows it.

``--wrong``: tracked recordings of rigs of which one camera is not where, what or when it is said to
be; poses beyond five deviations, and what is said.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
from scipy.stats import chi2, norm

import rs_localizer as rsl
from benchmarks.aided import believed
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import PERIOD_NS
from benchmarks.independent.motions import IntArray, Moving, hand, steady
from benchmarks.independent.rigs import Mounted, Scene, Views, middle_of, noisy_frames, views
from benchmarks.independent.rotations import Array, exponential, logarithm
from benchmarks.independent.scenes import visible
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


def _moved(metres: float, degrees: float, mounted: Mounted, rng: np.random.Generator) -> Mounted:
    ways = rng.normal(size=(2, 3))
    move, turn = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    turned = exponential(math.radians(degrees) * turn) @ mounted.rotation
    return replace(mounted, rotation=turned, translation=mounted.translation + metres * move)


def _longer(share: float, mounted: Mounted, rng: np.random.Generator) -> Mounted:
    return replace(mounted, camera=replace(_CAMERA, focal=(1.0 + share) * _CAMERA.focal))


def _later(seconds: float, mounted: Mounted, rng: np.random.Generator) -> Mounted:
    return replace(mounted, start=seconds)


WRONG: dict[str, Callable[[Mounted, np.random.Generator], Mounted]] = {
    "right": partial(_moved, 0.0, 0.0),
    "moved by 1 cm": partial(_moved, 0.01, 0.0),
    "moved by 3 cm": partial(_moved, 0.03, 0.0),
    "turned by 0.3 deg": partial(_moved, 0.0, 0.3),
    "turned by 2 deg": partial(_moved, 0.0, 2.0),
    "K 2 % short": partial(_longer, 0.02),
    "K 5 % short": partial(_longer, 0.05),
    "2 ms late": partial(_later, 0.002),
    "10 ms late": partial(_later, 0.01),
}
"""What the last camera of a rig has wrong; the others are as they are said to be."""
_FRAMES, _NOISE, _WIDER = 30, 0.3, 0.2  # of a recording; px; of the image, where landmarks are
_FIVE = float(chi2.isf(2.0 * norm.sf(5.0), 6))


def wrong(name: str, scene: Scene, fault: str, seed: int) -> str:
    """A line of two recordings of a hand-held rig, tracked with the settings of a user."""
    rng, told, far, said = np.random.default_rng(seed), RIGS[name], [], Counter[str]()
    middle, errors = middle_of(told), []
    for _ in range(2):
        true = {**told, list(told)[-1]: WRONG[fault](told[list(told)[-1]], rng)}
        motions, tracker = hand(1, rng), rsl.Tracker(rsl.Localizer(_rig(told)))
        seen = views(told, motions, np.zeros(1), 2 * _POINTS // len(told), scene, rng, _WIDER)
        for frame in range(_FRAMES):
            begin = 1e-9 * PERIOD_NS * (frame - _FRAMES // 2)
            parts = {}
            for each, mounted in true.items():
                points = seen[each].points
                exact = mounted.seen(motions, np.zeros(1, np.int64), np.array([begin]), points)
                shown = np.flatnonzero(visible(mounted.camera, exact)[0])[: _POINTS // len(told)]
                noisy = exact[0, shown] + _NOISE * rng.normal(size=(len(shown), 2))
                parts[each] = points[0, shown], noisy
            result = tracker.localize(10**15 + frame * PERIOD_NS, parts)
            said["extrinsics"] += bool(tracker.cameras.fault)
            if not result:
                said[str(result.reason)] += 1
                continue
            state = motions.states(np.zeros(1, np.int64), np.array([begin + middle]))
            errors.append(np.concatenate([
                logarithm(result.rotation @ state.rotation[0]),
                result.rotation @ (state.position[0] - result.position),
                state.angular[0] * result.span - result.angular_velocity,
                state.linear[0] * result.span - result.linear_velocity,
            ]))  # fmt: skip
            far.append([
                errors[-1][part] @ np.linalg.solve(result.covariance[part, part], errors[-1][part])
                for part in (slice(0, 6), slice(6, 12))
            ])  # fmt: skip
    off, squared = np.reshape(errors, (-1, 4, 3)), np.reshape(far, (-1, 2))
    middles = np.median(np.linalg.norm(off[:, :2], axis=2), axis=0) * _UNITS[:2] if far else [0, 0]
    inside = " ".join(f"{100 * np.mean(each < _REGION):.0f}" for each in squared.T if far)
    words = ", ".join(f"{count} {word}" for word, count in said.items() if count) or "nothing"
    return (
        f"| {name} | {scene} | {fault} | {len(far)} | {middles[0]:.2g}, {middles[1]:.2g} | "
        f"{inside} | {np.sum(squared.max(axis=1, initial=0.0) > _FIVE)} | {words} |"
    )


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.rigs", description="Poses of rigs against their bounds."
    )
    parser.add_argument("--wrong", action="store_true", help="rigs with a wrong camera")
    parser.add_argument("--frames", type=int, default=100, help="of each line")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    if options.wrong:
        heads = (
            "| rig | scene | last camera | of 60 | deg, mm | inside: pose, twist (%) | >5 | said |"
        )
        print(heads + "\n" + "|---" * 8 + "|")
        for name, scene, fault in product(
            ("two alike", "two opposed", "back to back"), Scene, WRONG
        ):
            if scene == Scene.RICH or name in _BEFORE_WALLS:
                print(wrong(name, scene, fault, options.seed), flush=True)
        return
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
