# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``Estimate.integrity`` in right maps and in wrong ones: is one per cent one in a hundred?

Simulated rooms, half a metre and half a radian per second, 15 frames at 15 Hz each, seen by plain
matches, features (250) and markers, 5 to 50 % of the matches wrong by chance (markers: none), and
in four of ten sequences a person who walks through, or a marker that is misread. 2 to 30 % of the
landmarks are stale, parts have moved, walls are exchanged, the whole map jumps within the sequence,
it is mirrored, or that of another room. A frame is wrong if its pose lies outside the region of
99.9 %. Views in which all had moved together from the first frame on are left out: nothing in them
tells.

Other scenes have few points; right matches in a part of the image only; landmarks in clusters; a
board in an empty view (right, or jumping). Weights are fitted to the first three of SCENES.

    python -m benchmarks.integrity                               # weights as they are
    python -m benchmarks.integrity --scenes board
    python -m benchmarks.integrity --fit                         # prints new ones
"""

import argparse
import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.optimize import minimize
from tqdm import tqdm

from rs_localizer import integrity
from rs_localizer.config import Acceleration
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.integrity import INNOVATION, Integrity
from rs_localizer.localizer import Localizer
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import (
    FrameSettings,
    SimulatedFrame,
    simulate_frames,
)
from rs_localizer.tools.simulation.true_motion import ConstantVelocity
from rs_localizer.tracking import Tracker

KINDS = ("right", "right", "stale", "moved", "swapped", "mirrored", "another", "jumped")
MATCHERS = ("plain", "features", "markers")
SCENES = ("whole", "few", "part", "clusters", "board")
FITTED = SCENES[:3]
RIGID = ("moved", "swapped")  # parts that a view may show alone
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
CAMERA = Camera(640, 480, K, readout_time=0.03)
FRAMES, RATE, SQUARES = 15, 15.0, 260
OUTSIDE = 22.46  # chi-squared of six numbers, 99.9 %
BASE = 0.02  # share of wrong frames for which it is calibrated
BINS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 0.7, 1.0)


class Row(NamedTuple):
    """One frame with a pose."""

    sequence: tuple[str, int]
    kind: str
    matcher: str
    wrong: bool
    numbers: Array
    seconds: float  # since the last one


def changed(kind: str, world: Array, rng: np.random.Generator) -> Array:
    """The map (m,3) of a room as somebody has it who comes later, or to another place."""
    found, middle = world.copy(), 0.5 * (world.min(axis=0) + world.max(axis=0))
    centre = world[rng.integers(len(world))]
    far = np.linalg.norm(world - centre, axis=1)
    half_turn = np.diag([-1.0, -1.0, 1.0])
    if kind == "moved":  # a part of the room, as furniture is
        part = far < np.quantile(far, rng.uniform(0.2, 0.6))
        turn = so3.exp(np.array([0.0, 0.0, rng.normal(0.0, 0.15)]))
        found[part] = (world[part] - centre) @ turn.T + centre + rng.normal(0, 0.4, 3) * [1, 1, 0.3]
    elif kind == "swapped":  # opposite walls
        axis = rng.integers(2)
        off = np.abs(world - middle)[:, axis]
        part = off > 0.6 * off.max()
        found[part] = (world[part] - middle) @ half_turn.T + middle
    elif kind == "mirrored":
        found[:, 0] = 2.0 * middle[0] - world[:, 0]
    elif kind == "another":  # matches by chance, and one structure that both rooms have
        found = world[rng.permutation(len(world))]
        part = far < np.quantile(far, rng.uniform(0.1, 0.35))
        turn = so3.exp(np.array([0.0, 0.0, rng.uniform(-np.pi, np.pi)]))
        found[part] = (world[part] - centre) @ turn.T + centre + rng.normal(0.0, 2.0, 3)
    elif kind == "repeated":  # as of windows: matches with their neighbours, a period away
        other = rng.random(len(world)) < rng.uniform(0.2, 0.7)
        found[other] += rng.uniform(0.5, 1.5) * np.eye(3)[rng.integers(2)]
    elif kind == "stale":
        gone = rng.random(len(world)) < rng.uniform(0.02, 0.3)
        found[gone] += rng.normal(0.0, 0.5, (gone.sum(), 3))
    elif kind == "jumped":
        step = rng.normal(size=3)
        found += rng.uniform(0.1, 1.0) * step / np.linalg.norm(step)
    return found


def squares(world: Array, rng: np.random.Generator) -> Array:
    """Corners (4 m,3) of markers of 20 cm at some of the points; a marker's lie m apart."""
    base = world[rng.choice(len(world), SQUARES, replace=False)]
    x = rng.normal(size=base.shape)
    x /= np.linalg.norm(x, axis=1)[:, None]
    y = np.cross(x, rng.normal(size=base.shape))
    y /= np.linalg.norm(y, axis=1)[:, None]
    return np.concatenate([base + 0.1 * (a * x + b * y)
                           for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))])  # fmt: skip


class View(NamedTuple):
    """What is seen of a map, and how."""

    world: Array  # (m,3) m
    settings: FrameSettings
    low: Array  # (2,) px, corners of the part of the image in which matches are right
    high: Array

    def shows(self, frame: SimulatedFrame) -> BoolArray:
        """Return which matches are there: wrong ones lie anywhere, and are as many as asked."""
        inside = np.all((frame.pixels > self.low) & (frame.pixels < self.high), axis=1)
        right, share = inside & frame.inliers, self.settings.outliers
        most = round(right.sum() * share / (1.0 - share))
        return np.asarray(right | (~frame.inliers & (np.cumsum(~frame.inliers) <= most)))


def view_of(
    scene: str, matcher: str, motion: ConstantVelocity, rng: np.random.Generator, number: int
) -> View:
    """The map of a sequence, and how it is seen."""
    size, other = np.array([640.0, 480.0]), np.random.default_rng([8, number])
    world = room(motion.state(0, np.linspace(0.0, 2.0, 9)).positions, rng, count=4000)
    seen = {
        "plain": (int(rng.integers(40, 160)), rng.uniform(0.3, 1.2), rng.uniform(0.05, 0.5)),
        "features": (250, rng.uniform(0.6, 1.2), rng.uniform(0.05, 0.5)),
        "markers": (4 * int(rng.integers(5, 14)), rng.uniform(0.1, 0.4), 0.0),
    }[matcher]
    low, high = np.zeros(2) - 50.0, size + 50.0
    if scene != "whole":
        noise, wrong = other.uniform(0.3, 1.5), other.uniform(0.0, 0.5)
        seen = int(other.integers(40, 160)), noise, wrong
    if scene == "few":
        seen = int(other.integers(12, 35)), noise, 0.8 * wrong
    elif scene == "part":
        half = other.uniform(0.12, 0.4, 2) * size
        middle = other.uniform(half, size - half)
        low, high, seen = middle - half, middle + half, (3 * seen[0], noise, wrong)
    elif scene == "clusters":
        centres = world[other.choice(len(world), int(other.integers(30, 120)))]
        about = other.normal(0.0, other.uniform(0.02, 0.15), (40, len(centres), 3))
        world = (centres + about).reshape(-1, 3)
    elif scene == "board":
        world, seen = board(motion, other), (200, 0.7 * noise, 0.4 * wrong)
    if matcher == "markers" and scene == "whole":
        world = squares(world, rng)
    return View(world, FrameSettings(*seen), low, high)


def board(motion: ConstantVelocity, rng: np.random.Generator) -> Array:
    """Corners (n,3) of a board before the camera, as it stands after half a second."""
    state, side = motion.state(0, np.full(1, 0.5)), int(rng.integers(5, 10))
    step = np.arange(side) - 0.5 * (side - 1)
    flat = np.stack([*map(np.ravel, np.meshgrid(step, step)), np.zeros(side**2)], axis=1)
    length = rng.uniform(0.05, 0.15)
    tilted = length * flat @ so3.exp(rng.normal(0.0, 0.4, 3)).T
    tilted[:, 2] += rng.uniform(1.5, 3.0) * length * side
    return np.asarray(tilted @ state.rotations[0].T + state.positions[0])


def sequence(number: int, kinds: Sequence[str] = KINDS, scene: str = "whole") -> list[Row]:
    """The frames of one sequence that have a pose."""
    kind = kinds[number % len(kinds)]
    if scene == "board" and kind != "jumped":
        kind = "right"
    matcher = MATCHERS[(number // len(kinds)) % len(MATCHERS)] if scene == "whole" else "plain"
    rng = np.random.default_rng([7, number])
    calm = 0.3 if scene == "board" else 1.0  # it is to stay in view
    motion = ConstantVelocity(rng.normal(0, 0.6 * calm, 3), rng.normal(0, 0.5 * calm, 3), 3.0)
    view = view_of(scene, matcher, motion, rng, number)
    world, later = view.world, changed(kind, view.world, rng)
    if matcher == "markers" and kind in ("moved", "stale", "another"):  # whole ones
        later = world + np.tile((later - world).reshape(4, -1, 3).mean(axis=0), (4, 1))
    tracker, judge = Tracker(Localizer(CAMERA)), Integrity(Acceleration())
    person = rng.random() < 0.4 and scene != "board"
    centre, size = rng.uniform([0.0, 0.0], [640.0, 480.0]), rng.uniform(50.0, 170.0)
    drift = rng.normal(0.0, 25.0, 2)
    stamps = [round(1e9 + 1e9 * i / RATE) for i in range(FRAMES)]
    rows: list[Row] = []
    last_ns = stamps[0]
    jumps = stamps[int(rng.integers(4, 10))] if kind == "jumped" else 0
    for frame in simulate_frames(
        CAMERA, motion, world, view.settings, stamps_ns=stamps, seed=number
    ):
        shown = view.shows(frame)
        ids, pixels = frame.ids[shown], frame.pixels[shown]
        seen = (later if frame.stamp_ns >= jumps else world)[ids]
        if person and matcher == "markers":
            marker = ids % SQUARES
            hit = marker == rng.choice(np.unique(marker)) if len(marker) else marker > 0
            pixels[hit] += rng.normal(0.0, 15.0, 2)
        elif person:
            hit = np.linalg.norm(pixels - centre, axis=1) < size
            pixels[hit] += drift + rng.normal(0.0, 3.0, (hit.sum(), 2))
            centre = centre + drift
        prior = tracker.prediction(frame.middle_ns)
        result = tracker.localize(frame.middle_ns, seen, pixels) if len(ids) else None
        if not result:
            continue
        seconds, last_ns = 1e-9 * (frame.middle_ns - last_ns), frame.middle_ns
        numbers = judge.numbers(result, seen, prior, seconds)
        true = frame.motion
        turn = so3.log(np.ascontiguousarray(true.rotation @ result.rotation.T))
        way = true.rotation @ (result.position + true.rotation.T @ true.translation)
        off = np.r_[turn, way]
        outside = off @ np.linalg.solve(result.covariance[:6, :6], off) > OUTSIDE
        share = float(np.mean(np.any(np.abs(seen - world[ids]) > 1e-9, axis=1)))
        if kind in RIGID and share > 0.95:
            continue
        rows.append(Row((scene, number), kind, matcher, bool(outside), numbers, seconds))
    return rows


def recursive(rows: list[Row]) -> Array:
    """The integrity of each frame."""
    found, judge, last = [], Integrity(Acceleration()), ("", -1)
    for row in rows:
        if row.sequence != last:
            judge.reset()
            last = row.sequence
        found.append(judge.add(row.numbers, row.seconds))
    return np.array(found)


def weights_of(wrong: Array) -> Array:
    """Of each frame, so that the share of wrong ones is that of the calibration."""
    share = wrong.mean()
    return np.asarray(np.where(wrong, BASE / share, (1.0 - BASE) / (1.0 - share)))


def _jumps(rows: list[Row]) -> tuple[Array, Array]:
    """Innovations of frames after right ones, and whether the whole map has jumped with them."""
    pairs = [
        (row.numbers[INNOVATION], row.kind == "jumped" and row.wrong)
        for before, row in itertools.pairwise(rows)
        if before.sequence == row.sequence and not before.wrong
        if not row.wrong or row.kind == "jumped"
    ]
    innovations, jumped = map(np.array, zip(*pairs, strict=True))
    return innovations, jumped


def _regression(numbers: Array, wrong: Array, share: float, missed: float) -> Array:
    """Constant and factors of the logarithmic odds that a frame is wrong.

    Args:
        numbers, wrong: (n,k), (n,) of the frames.
        share: of wrong ones, for which they are weighted.
        missed: share of the wrong ones that look as right ones do.
    """
    mean, spread = numbers.mean(axis=0), numbers.std(axis=0) + 1e-9
    scaled = (numbers - mean) / spread
    weights = np.where(wrong, share / wrong.mean(), (1.0 - share) / (1.0 - wrong.mean()))

    def loss(w: Array) -> float:
        said = 1.0 / (1.0 + np.exp(-w[0] - scaled @ w[1:]))
        told = np.where(wrong, said + (1.0 - said) * missed, 1.0 - said)
        return float(np.mean(weights * -np.log(told + 1e-12))) + 1e-3 * share * float(w[1:] @ w[1:])

    w = minimize(loss, np.r_[math.log(share), np.zeros(numbers.shape[1])]).x
    return np.asarray(np.r_[w[0] - np.sum(w[1:] * mean / spread), w[1:] / spread])


def fit(rows: list[Row]) -> None:
    """Print new constants."""
    shown = [row for row in rows if row.kind != "jumped"]  # in which frames show what is wrong
    numbers, wrong = map(np.array, zip(*((row.numbers, row.wrong) for row in shown), strict=True))
    own = [k for k in range(numbers.shape[1]) if k != INNOVATION]
    found = _regression(numbers[:, own], wrong, 0.5, 0.05)
    innovations, jumped = _jumps(rows)
    jump = _regression(innovations[:, None], jumped, 0.002, 0.0)
    after = [b for a, b in itertools.pairwise(rows) if a.sequence == b.sequence and a.wrong]
    returned = sum(not row.wrong for row in after)
    integrity.RETURNS = returned / sum(row.seconds for row in after)
    wrong, best = np.array([row.wrong for row in rows]), (np.inf, 0.0, 0.0, 0.0, integrity.JUMP)
    share = weights_of(wrong)
    for more, temper, recovers, odds in itertools.product(
        (0.0, 0.5, 1.0), (0.3, 0.4, 0.6), (3.3, 7.7, 13.7), (integrity.JUMP, tuple(jump))
    ):
        tried = more, temper, recovers, odds
        _use(found, *tried)
        said = np.clip(recursive(rows), 1e-6, 1.0 - 1e-6)
        cost = float(np.mean(share * -np.log(np.where(wrong, said, 1.0 - said))))
        best = min(best, (cost, *tried))
    _use(found, *best[1:])
    print("WEIGHTS", np.round(integrity.WEIGHTS, 3).tolist(), "JUMP", np.round(integrity.JUMP, 2))
    print("TEMPER, RECOVERS", best[2:4], f"RETURNS {integrity.RETURNS:.2f}")


def _use(
    found: Array, more: float, temper: float, recovers: float, odds: tuple[float, ...]
) -> None:
    """Judge by these from now on: ``more`` is added to the constant."""
    integrity.WEIGHTS = np.insert(np.r_[found[0] + more, found[1:]], 1 + INNOVATION, 0.0)
    integrity.TEMPER, integrity.RECOVERS, integrity.JUMP = temper, recovers, (odds[0], odds[1])


def report(rows: list[Row]) -> None:
    """Reliability, ROC and detection, as text."""
    said, wrong = recursive(rows), np.array([row.wrong for row in rows])
    share = weights_of(wrong)
    print(f"{len(rows)} frames, {wrong.sum()} wrong, weighted to {BASE:.0%}")
    errors = 0.0
    for low, high in itertools.pairwise(BINS):
        here = (said >= low) & (said < high)
        if here.any():
            pair = [np.average(each[here], weights=share[here]) for each in (said, wrong)]
            errors += abs(pair[0] - pair[1]) * share[here].sum() / share.sum()
            print(f"  {low:5.3f} to {high:5.3f}: {here.sum():5} frames, said {pair[0]:.4f}, "
                  f"found {pair[1]:.4f}")  # fmt: skip
    print(f"expected calibration error {errors:.4f}")
    order = np.argsort(-said)
    hits, alarms = np.cumsum(wrong[order]) / wrong.sum(), np.cumsum(~wrong[order]) / (~wrong).sum()
    print(f"area below the ROC {np.trapezoid(hits, alarms):.3f}")
    in_right = np.array([row.kind == "right" for row in rows])
    most, hours = float(said[in_right & ~wrong].max()), in_right.sum() / RATE / 3600.0
    found = np.mean(said[wrong] > most)
    print(f"right maps: none above {most:.2f} in {hours:.2f} h; {found:.0%} of wrong frames are")
    print("above one half, of right and of wrong frames; wrong sequences found")
    for kind in dict.fromkeys(row.kind for row in rows):
        own = np.array([row.kind == kind for row in rows])
        counts = [f"{np.sum(said[own & of] > 0.5)} of {np.sum(own & of)}" for of in (~wrong, wrong)]
        lost = {row.sequence for row in rows if row.kind == kind and row.wrong}
        alarmed = {row.sequence for row, p in zip(rows, said, strict=True) if row.wrong and p > 0.5}
        print(f"  {kind}: {counts[0]}; {counts[1]}; {len(lost & alarmed)} of {len(lost)}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sequences", type=int, default=240)
    parser.add_argument("--first", type=int, default=480, help="below 480 are those of the fit")
    parser.add_argument("--fit", action="store_true", help="print new weights, of the first ones")
    parser.add_argument("--kinds", nargs="+", default=KINDS, help="also: repeated")
    parser.add_argument("--scenes", nargs="+", choices=SCENES, default=SCENES)
    chosen = parser.parse_args()
    first, scenes = (0, FITTED) if chosen.fit else (chosen.first, chosen.scenes)
    numbers = range(first, first + chosen.sequences)
    made = {
        scene: [row for number in tqdm(numbers, desc=scene, disable=None)
                for row in sequence(number, chosen.kinds, scene)]
        for scene in scenes
    }  # fmt: skip
    if chosen.fit:
        fit([row for rows in made.values() for row in rows])
    for scene, rows in made.items():
        print(f"scene {scene}")
        report(rows)


if __name__ == "__main__":
    main()
