# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What is noticed of faults that the model of a frame does not have, and what is not.

python -m benchmarks.kinds --seeds 1 2
python -m benchmarks.kinds hour --seeds 0 30

Each row is one kind of fault: two recordings of a hand-held camera before landmarks that stay where
they are, through the code that node and ``replay`` share. Nothing of the package makes the frames.
Columns: how many of 60 frames are published, median errors of the pose at the stamp and of the
angular velocity, how many of the published poses and of the known twists lie in their 95 % regions,
how many are beyond five standard deviations in either, and what is said (notices, and reasons of
refusals).

``hour``: right cameras and maps in recordings from one seed to another one, 30 of which are an hour
together, and in how many of them something is said.
"""

import argparse
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from scipy.ndimage import uniform_filter1d
from scipy.stats import chi2, norm

from benchmarks.experiments.results import Table
from benchmarks.independent.cameras import Camera
from benchmarks.independent.frames import PERIOD_NS
from benchmarks.independent.motions import Motions, States, hand, steady
from benchmarks.independent.rotations import Array, exponential, logarithm
from benchmarks.independent.scenes import visible
from rs_localizer.config import CalibrationErrors, NodeConfig
from rs_localizer.io.camera_info import Calibration
from rs_localizer.io.clouds import Correspondences
from rs_localizer.io.outputs import Localized
from rs_localizer.pipeline.camera_frames import CameraFrames

_RECORDINGS, _LENGTH, _NOISE = 2, 30, 0.1  # frames each, px
_START_NS = 10**15
_SIZE = (640, 480)
_READOUT = 0.03
# What frames say that see too little of a map: the last one, one row of a board.
_NO_WORD = ("too_few_points", "uncertain", "no_hypothesis")
_INSIDE = float(chi2.ppf(0.95, 6))
_FIVE = float(chi2.isf(2.0 * norm.sf(5.0), 6))
_WELL = CalibrationErrors(
    principal_point=0.1, focal_length=4e-4, distortion=0.05, aspect_ratio=4e-4
)
"""Of a good calibration."""
_ORDINARY = NodeConfig()

_LENS = Camera(focal=500.0, readout_time=_READOUT)
_MILD = Camera(focal=500.0, readout_time=_READOUT, distortion=(-0.02, 0.005, 0.0, 0.0, 0.0))
_PLAIN = Camera(focal=500.0, readout_time=_READOUT, distortion=(0.0,) * 5)


class Seen(NamedTuple):
    """What the camera is believed to be and what it shows in f frames of n landmarks."""

    K: Array
    D: tuple[float, ...]
    points: Array  # (n,3) as the map has them
    pixels: Array  # (f,n,2) without noise
    bearings: Array  # (f,n,2) that these pixels had before anything happened to them
    rotations: Array  # (f,3,3) map_from_camera at the middle row


Fault = Callable[[Seen, np.random.Generator], Seen]


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of fault, and one instance of it."""

    name: str
    scene: Callable[[np.random.Generator], Array]
    fault: Fault
    tracked: bool = True
    camera: Camera = _PLAIN
    settings: NodeConfig = _ORDINARY
    motion: Callable[[int, np.random.Generator], Motions] = hand
    noise: float = _NOISE


# Landmarks in the axes of the camera at rest, m.


def _square(side: float) -> Array:
    return 0.5 * side * np.array([[-1.0, 1.0], [1.0, 1.0], [1.0, -1.0], [-1.0, -1.0]])


def _corner(rng: np.random.Generator) -> Array:
    """Markers of 20 cm in two rows on the two walls of a corner."""
    places = [
        (along, up) for along in (-1.3, -0.9, -0.5, -0.1, 0.3, 0.7, 1.1) for up in (-0.3, 0.3)
    ]
    flat = np.concatenate([_square(0.2) + place + rng.normal(0.0, 0.03, 2) for place in places])
    return np.column_stack([0.8 * flat[:, 0], flat[:, 1], 2.6 - 0.6 * np.abs(flat[:, 0])])


def _wall(rng: np.random.Generator) -> Array:
    """Markers of 20 cm on one wall, at up to 35 deg."""
    places = [(x, y) for x in (-0.9, -0.45, 0.0, 0.45, 0.9) for y in (-0.55, 0.0, 0.55)]
    flat = np.concatenate([_square(0.2) + place + rng.normal(0.0, 0.03, 2) for place in places])
    return _tilted(np.column_stack([flat, np.zeros(len(flat))]), 2.0, rng)


def _board(rng: np.random.Generator, *degrees: float) -> Array:
    """A chessboard of 9 x 6 corners, half a metre wide, 1 m away."""
    x, y = np.meshgrid(np.linspace(-0.25, 0.25, 9), np.linspace(-0.156, 0.156, 6))
    return _tilted(np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)]), 1.0, rng, *degrees)


def _facing(rng: np.random.Generator) -> Array:
    """The board, nearly parallel to the image."""
    return _board(rng, 0.0, 5.0)


def _hall(rng: np.random.Generator) -> Array:
    """Points around a way of ten metres."""
    return np.asarray(rng.uniform(-9.0, 9.0, (200, 3)) * [1.0, 0.3, 1.0])


def _room(rng: np.random.Generator) -> Array:
    """Points at all depths."""
    low, high = (-1.8, -1.2, 1.5), (1.8, 1.2, 4.0)
    return np.asarray(rng.uniform(low, high, (150, 3)))


def _tilted(
    flat: Array, distance: float, rng: np.random.Generator, least: float = 10.0, most: float = 35.0
) -> Array:
    """By so many degrees about an axis in the image."""
    around = rng.uniform(0.0, 2.0 * np.pi)
    axis = np.array([np.cos(around), np.sin(around), 0.0])
    turned: Array = flat @ exponential(np.radians(rng.uniform(least, most)) * axis).T
    turned[:, 2] += distance
    return turned


# Faults.


def right(seen: Seen, rng: np.random.Generator) -> Seen:
    return seen


def squeezed(across: float, along: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """The image is scaled about its centre; K is that of before."""
    centre = seen.K[:2, 2]
    return seen._replace(pixels=(seen.pixels - centre) * [across, along] + centre)


def other_resolution(share: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """K is that of images of another size, and only width and height were corrected."""
    K = seen.K * share
    K[2, 2] = 1.0
    return seen._replace(K=K)


def other_lens(share: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """The focal length is that of another lens."""
    K = seen.K.copy()
    K[0, 0] *= share
    K[1, 1] *= share
    return seen._replace(K=K)


def other_mode(
    share: float, centre: tuple[float, float], seen: Seen, rng: np.random.Generator
) -> Seen:
    """K is that of a mode that shows another part of the sensor, in other pixels."""
    K = np.diag([share * seen.K[0, 0], share * seen.K[1, 1], 1.0])
    K[:2, 2] = centre
    return seen._replace(K=K)


def rectified(share: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """The images have lost a part of the distortion, the lens that is told has it all."""
    straight = seen.bearings * np.diag(seen.K)[:2] + seen.K[:2, 2]
    return seen._replace(pixels=seen.pixels + share * (straight - seen.pixels))


def stabilised(share: float, zoom: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """The images are turned to where the camera looks in the mean of half a second, and zoomed."""
    turns = logarithm(np.swapaxes(seen.rotations[:1], 1, 2) @ seen.rotations)
    back = uniform_filter1d(turns, 15, axis=0, mode="nearest") - turns
    turn = exponential(-share * back)  # in camera axes, small
    local = np.concatenate([seen.bearings, np.ones((*seen.bearings.shape[:2], 1))], axis=-1)
    local = local @ np.swapaxes(turn, 1, 2)
    bearings = local[..., :2] / local[..., 2:]
    return seen._replace(pixels=zoom * bearings * np.diag(seen.K)[:2] + seen.K[:2, 2])


def part_moved(share: float, distance: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """A part of the map lies elsewhere than the map says."""
    points, shift = seen.points.copy(), rng.normal(size=3)
    along = points @ rng.normal(size=3)
    points[along > np.quantile(along, 1.0 - share)] += distance * shift / np.linalg.norm(shift)
    return seen._replace(points=points)


def stretched(share: float, seen: Seen, rng: np.random.Generator) -> Seen:
    """The map is longer in one direction than the room, and lies as that does in the middle.

    Landmarks span the direction: across a wall, a stretch would only turn the wall.
    """
    away = seen.points - seen.points.mean(axis=0)
    along = rng.normal(size=len(away)) @ away
    along /= np.linalg.norm(along)
    return seen._replace(points=seen.points + share * (away @ along)[:, None] * along)


_CALM = partial(hand, slower=3.0)


def kinds() -> list[Kind]:
    """The rows, a control of each scene before its faults."""
    well = NodeConfig(calibration=_WELL)
    return [
        Kind("right: corner", _corner, right),
        Kind("right: wall", _wall, right),
        Kind("right: board", _board, right),
        Kind("right: facing board", _facing, right, motion=_CALM),
        Kind("right: room", _room, right),
        Kind("right: corner, good lens", _corner, right, camera=_LENS, settings=well),
        Kind("squeezed by 0.7 %, corner", _corner, partial(squeezed, 1.0, 0.993)),
        Kind("squeezed by 2 %, corner", _corner, partial(squeezed, 1.0, 0.98)),
        Kind("stretched by 3 %, room", _room, partial(squeezed, 1.0, 1.03)),
        Kind("squeezed by 25 %, corner", _corner, partial(squeezed, 1.0, 0.75)),
        Kind("squeezed across by 5 %, corner", _corner, partial(squeezed, 0.95, 1.0)),
        Kind("K of twice the size, wall", _wall, partial(other_resolution, 2.0)),
        Kind("K of 1.5 times the size, wall", _wall, partial(other_resolution, 1.5)),
        Kind("K of half the size, single", _wall, partial(other_resolution, 0.5), False),
        *(Kind(f"K of {size}, {name}", scene, partial(other_mode, share, centre), motion=motion)
          for size, share, centre in (("1280 x 720", 1.5, (640.0, 360.0)),
                                      ("640 x 640", 1.0, (320.0, 320.0)))
          for name, scene, motion in (("wall", _wall, hand), ("board", _board, hand),
                                      ("facing board", _facing, _CALM))),
        Kind("f of 1.9 times, board", _board, partial(other_lens, 1.9)),
        Kind("f of 0.6 times, board, single", _board, partial(other_lens, 0.6), False),
        *(Kind(f"f of {share:g} times, facing board", _facing, partial(other_lens, share),
               motion=_CALM) for share in (1.9, 0.6, 1.1)),
        Kind("rectified, corner", _corner, partial(rectified, 1.0), camera=_LENS, settings=well),
        Kind("rectified, usual deviations", _corner, partial(rectified, 1.0), camera=_LENS),
        Kind("mild lens, rectified, corner", _corner, partial(rectified, 1.0), camera=_MILD,
             settings=well),
        Kind("mild lens, rectified, usual", _corner, partial(rectified, 1.0), camera=_MILD),
        Kind("stabilised, corner", _corner, partial(stabilised, 0.7, 1.0), settings=well),
        Kind("stabilised and zoomed, room", _room, partial(stabilised, 0.7, 1.1)),
        Kind("half map moved 1 cm, corner", _corner, partial(part_moved, 0.5, 0.01)),
        Kind("half map moved 3 cm, room", _room, partial(part_moved, 0.5, 0.03)),
        Kind("half map moved 10 cm, room", _room, partial(part_moved, 0.5, 0.1)),
        Kind("half map moved 50 cm, room", _room, partial(part_moved, 0.5, 0.5)),
        Kind("third moved 1 cm, corner", _corner, partial(part_moved, 1.0 / 3.0, 0.01)),
        Kind("map stretched by 1 %, corner", _corner, partial(stretched, 0.01)),
        Kind("map stretched by 1 %, board", _board, partial(stretched, 0.01)),
        Kind("map stretched by 2 %, wall", _wall, partial(stretched, 0.02)),
        Kind("map stretched by 1 %, wall", _wall, partial(stretched, 0.01)),
        Kind("so, map_deviation 5 mm, wall", _wall, partial(stretched, 0.01),
             settings=NodeConfig(map_deviation=0.005)),
    ]  # fmt: skip


_SECONDS = 20
"""Of a recording of each of six kinds, two minutes."""
_SEEN = "published"


def hour(runs: range) -> Table:
    """What is said of right cameras and maps."""
    drive = partial(steady, rate=0.3, speed=0.5)
    every = [
        Kind("hand, corner", _corner, right),
        Kind("hand, wall, 0.3 px", _wall, right, noise=0.3),
        Kind("hand, board", _board, right),
        Kind("calm hand, facing board, 0.3 px", _facing, right, motion=_CALM, noise=0.3),
        Kind("hand, room", _room, right),
        Kind("drive, hall, 0.3 px", _hall, right, motion=drive, noise=0.3),
    ]
    said: dict[str, Counter[str]] = {kind.name: Counter() for kind in every}
    for run in runs:
        for kind in every:
            tally = judged(kind, run, 1, round(1e9 * _SECONDS / PERIOD_NS))
            names = [name for name in tally.said if name not in _NO_WORD]
            said[kind.name].update([*names, _SEEN] if tally.published else names)
        sys.stderr.write(f"{run} of {runs}: { ({k: dict(c) for k, c in said.items()}) }\n")
    rows = []
    for name, heard in said.items():
        seen = heard.pop(_SEEN, 0)
        words = ", ".join(f"{word} {count}" for word, count in heard.most_common())
        rows.append((name, f"{seen}", words or "nothing"))
    return Table(("kind", "recordings", "said, in so many of them"), rows)


class _Tally:
    """What became of the frames of a row."""

    def __init__(self) -> None:
        self.published = self.twists = 0
        self.inside, self.beyond = np.zeros(2, int), 0
        self.errors: list[tuple[float, float, float]] = []
        self.said: Counter[str] = Counter()
        self.texts: dict[str, str] = {}

    def hear(self, name: object, text: str) -> None:
        self.said[str(name)] += 1
        self.texts[str(name)] = text

    def add(self, found: Localized, true: States, at: int) -> None:
        self.published += 1
        place = found.pose.position - true.position[at]
        turn = logarithm((found.pose.rotation @ true.rotation[at].T)[None])[0]
        rate = np.nan
        far = [_squared(np.r_[place, turn], found.pose.covariance)]
        twist = found.known_twist
        if twist is not None:
            off = twist.angular - true.angular[at]
            rate = float(np.degrees(np.linalg.norm(off)))
            far.append(_squared(np.r_[twist.linear - true.linear[at], off], twist.covariance))
            self.twists += 1
        self.errors.append(
            (1e3 * float(np.linalg.norm(place)), float(np.degrees(np.linalg.norm(turn))), rate)
        )
        self.inside[: len(far)] += np.array(far) < _INSIDE
        self.beyond += max(far) > _FIVE

    def row(self, name: str) -> tuple[str, ...]:
        errors = np.array(self.errors).reshape(-1, 3)
        cells = [
            f"{float(f'{np.nanmedian(each):.2g}'):g}" if np.isfinite(each).any() else "-"
            for each in errors.T
        ]
        inside = [
            f"{100 * hits / count:.0f}" if count else "-"
            for hits, count in zip(self.inside, (self.published, self.twists), strict=True)
        ]
        said = [name for name, _ in self.said.most_common() if name not in _NO_WORD]
        heard = ", ".join(said[:2]) or "nothing"
        return name, f"{self.published}", *cells, " ".join(inside), f"{self.beyond}", heard


def _squared(off: Array, covariance: Array) -> float:
    return float(off @ np.linalg.solve(covariance, off))


def judged(kind: Kind, seed: int, count: int = _RECORDINGS, length: int = _LENGTH) -> _Tally:
    """The frames of a kind, localized: so many recordings of so many frames."""
    rng = np.random.default_rng([seed, *kind.name.encode()])
    motions, camera = kind.motion(count, rng), kind.camera
    tally, scene = _Tally(), kind.scene(rng)
    times = 1e-9 * PERIOD_NS * (np.arange(length, dtype=np.float64) - length // 2)
    for k in range(count):
        here = np.full(length, k)
        # Every recording has its own map: the scene stands before its first pose.
        exact, bearings, points = _frames(kind, motions, k, scene, times)
        middle = motions.poses(here, times + 0.5 * camera.readout_time)[0]
        seen = Seen(camera.matrix, camera.distortion, points, exact, bearings, middle)
        _localize(kind, kind.fault(seen, rng), motions.states(here, times), rng, tally)
    return tally


def _frames(
    kind: Kind, motions: Motions, k: int, scene: Array, times: Array
) -> tuple[Array, Array, Array]:
    """Exact pixels (f,n,2), their bearings, and the landmarks (n,3) of a recording."""
    camera = kind.camera
    points = motions.position[k] + scene @ motions.rotation[k].T
    every = np.broadcast_to(points, (len(times), *points.shape))

    def local_at(delay: Array) -> Array:
        now = (times[:, None] + delay).ravel()
        rotation, position = motions.poses(np.full(len(now), k), now)
        local = np.einsum("nji,nj->ni", rotation, every.reshape(-1, 3) - position)
        return np.asarray(local.reshape(every.shape))

    exact = camera.project_rolling(local_at, every.shape[:2])
    return exact, camera.bearings(exact), points


def _localize(
    kind: Kind, told: Seen, true: States, rng: np.random.Generator, tally: _Tally
) -> None:
    config = replace(kind.settings, readout_time=kind.camera.readout_time, tracking=kind.tracked)
    localizer = CameraFrames(config, tally.hear)
    K = tuple(map(float, told.K.ravel()))
    localizer.calibrate(Calibration("camera", *_SIZE, K, told.D, "plumb_bob", (1, 1), None))
    shown = visible(kind.camera, told.pixels)
    for frame, pixels in enumerate(told.pixels):
        points = told.points[shown[frame]]
        noisy = pixels[shown[frame]] + rng.normal(0.0, kind.noise, (len(points), 2))
        table = np.zeros(len(points), [*((name, float) for name in "xyzuv"), ("id", np.uint32)])
        for name, column in zip("xyzuv", np.c_[points, noisy].T, strict=True):
            table[name] = column
        table["id"] = np.flatnonzero(shown[frame])
        stamp = _START_NS + frame * PERIOD_NS
        cloud = Correspondences(stamp, "map", points, noisy, None, 0, table)
        found = localizer.localize_cloud(cloud)
        if found:
            tally.add(found, true, frame)
        elif found is not None:
            tally.hear(found.reason, found.detail)


def main(arguments: Sequence[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.kinds", description=__doc__)
    parser.add_argument("what", nargs="?", choices=["hour"], help="of right cameras and maps")
    parser.add_argument("--seeds", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--only", nargs="+", default=[], help="words of rows")
    parser.add_argument("--say", action="store_true", help="also what was said last, of each name")
    options = parser.parse_args(arguments)
    if options.what:
        print(hour(range(*options.seeds)).text())
        return 0
    rows = []
    for kind in kinds():
        if not all(word in kind.name for word in options.only):
            continue
        for seed in options.seeds:
            tally = judged(kind, seed)
            rows.append(tally.row(kind.name if seed == options.seeds[0] else ""))
            sys.stderr.write(f"{kind.name:40} {rows[-1]}\n")
            if options.say:
                for name, text in tally.texts.items():
                    sys.stderr.write(f"    {name} {tally.said[name]}: {text}\n")
    heads = ("kind", "of 60", "mm", "deg", "deg/s", "inside %", ">5", "said")
    print(Table(heads, rows).text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
