# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs with a wrong camera: ``python -m benchmarks.rigs``.

Tracked recordings of the independent simulator, of rigs of which one camera is not where, what or
when it is said to be; poses beyond five deviations, and what is said.
"""

import argparse
import math
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

import rs_localizer as rsl
from benchmarks.aided import believed
from benchmarks.frames.judged import FIVE_SIGMA, REGION
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import PERIOD_NS
from benchmarks.independent.motions import hand
from benchmarks.independent.rigs import Mounted, Scene, middle_of, views
from benchmarks.independent.rotations import Array, exponential, logarithm
from benchmarks.independent.scenes import visible

_CAMERA = Camera(focal=450.0)
_POINTS = 152  # of all cameras
_UPRIGHT, _TURNED = np.eye(3), np.diag([-1.0, -1.0, 1.0])
_UNITS = np.array([math.degrees(1.0), 1e3])


def _at(rotation: Array, centre: tuple[float, float, float]) -> Mounted:
    return Mounted(_CAMERA, rotation, -rotation @ np.array(centre))


def _around(degrees: float) -> Mounted:
    """A camera that looks outwards, 5 cm from the middle."""
    turned = exponential(np.array([0.0, -math.radians(degrees), 0.0]))
    return Mounted(_CAMERA, turned, np.array([0.0, 0.0, -0.05]))


RIGS: dict[str, dict[str, Mounted]] = {
    "two alike": {"a": _at(_UPRIGHT, (-0.05, 0.0, 0.0)), "b": _at(_UPRIGHT, (0.05, 0.0, 0.0))},
    "two opposed": {"a": _at(_UPRIGHT, (-0.05, 0.0, 0.0)), "b": _at(_TURNED, (0.05, 0.0, 0.0))},
    "back to back": {"a": _around(0.0), "b": _around(180.0)},
}


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


def wrong(name: str, scene: Scene, fault: str, seed: int) -> str:
    """A line of two recordings of a hand-held rig, tracked with the settings of a user."""
    rng, told, far, said = np.random.default_rng(seed), RIGS[name], [], Counter[str]()
    middle, errors = middle_of(told), []
    places = {each: (mounted.rotation, mounted.translation) for each, mounted in told.items()}
    localizer = rsl.Localizer(rsl.Rig(dict.fromkeys(told, believed(_CAMERA)), places))
    for _ in range(2):
        true = {**told, list(told)[-1]: WRONG[fault](told[list(told)[-1]], rng)}
        motions, tracker = hand(1, rng), rsl.Tracker(localizer)
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
    middles = np.median(np.linalg.norm(off[:, :2], axis=2), axis=0) * _UNITS if far else [0, 0]
    inside = " ".join(f"{100 * np.mean(each < REGION):.0f}" for each in squared.T if far)
    words = ", ".join(f"{count} {word}" for word, count in said.items() if count) or "nothing"
    return (
        f"| {name} | {scene} | {fault} | {len(far)} | {middles[0]:.2g}, {middles[1]:.2g} | "
        f"{inside} | {np.sum(squared.max(axis=1, initial=0.0) > FIVE_SIGMA)} | {words} |"
    )


def main(arguments: list[str] | None = None) -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.rigs", description=__doc__)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args(arguments)
    print("| rig | scene | last camera | of 60 | deg, mm | inside: pose, twist (%) | >5 | said |")
    print("|---" * 8 + "|")
    for name, scene, fault in product(RIGS, Scene, WRONG):
        if scene == Scene.RICH or name != "back to back":
            print(wrong(name, scene, fault, options.seed), flush=True)


if __name__ == "__main__":
    main()
