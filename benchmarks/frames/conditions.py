# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The benches: tables of conditions, and nothing else."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.data import SLOW_HAND_MOTION
from benchmarks.independent import motions
from benchmarks.independent.cameras import Camera, Scan
from benchmarks.independent.motions import Moving
from benchmarks.independent.scenes import Board, Rich, Scene, SmallPlane, Wall
from rs_localizer import data


@dataclass(frozen=True)
class Motion:
    """A motion by name (of ``benchmarks.independent.motions``) and its arguments.

    Conditions that are equal here and in scene, camera and length share their frames.
    """

    name: str
    arguments: tuple[tuple[str, Any], ...] = ()

    def __call__(self, count: int, rng: np.random.Generator) -> Moving:
        make: Callable[..., Moving] = RECORDED.get(self.name) or getattr(motions, self.name)
        return make(count, rng, **dict(self.arguments))


def moving(name: str, **arguments: Any) -> Motion:
    return Motion(name, tuple(arguments.items()))


@dataclass(frozen=True)
class Sequence:
    """Frames of a recording that are tracked, those that count, and those of them that are bad."""

    length: int = 1
    counted: tuple[int, int] = (0, 1)
    # First, one after the last, and by how many px 60 % of the matches are shifted.
    bad: tuple[int, int, float] = (0, 0, 0.0)


SINGLE = Sequence()
# As long as a tracker needs to settle, and the five after that.
TRACKED = Sequence(8, (3, 8))
_BOTH = ("", SINGLE), ("/tracked", TRACKED)  # what names end in


@dataclass(frozen=True)
class Calibration:
    """What the calibration is off by: every fourth recording in another direction."""

    centre: float = 0.0  # px
    focal: float = 0.0  # share
    distortion: float = 0.0  # share that is missing
    boards: int = 0  # views of a chessboard that it was found from; 0: it was not
    readout_time: float | None = None  # s; None: right
    scan: Scan | None = None


EXACT = Calibration()


@dataclass(frozen=True)
class Points:
    """What is wrong with the matches beside their noise."""

    wrong: float = 0.0  # share, anywhere in the image
    tails: float = np.inf  # degrees of freedom of Student's t, of which ``noise`` is the scale
    shift: float = 0.0  # px, the same for all points of a recording
    alike: tuple[float, float] = (0.0, 0.0)  # share that is shifted alike, px
    near: tuple[float, float] = (0.0, 0.0)  # share that is wrong by up to so many px, each alone
    # Share on one side of the image that is matched with points so many m on along a facade.
    slip: tuple[float, float] = (0.0, 0.0)
    body: float = 0.0  # share that is on another body that moves
    bent_map: float = 0.0  # m, rms of each coordinate, in long waves
    rough_map: float = 0.0  # m, each point alone
    gyroscope: bool = False  # says how the camera turned


CLEAN = Points()


WIDE = Camera()


@dataclass(frozen=True)
class Condition:
    """One row of a table."""

    bench: str
    name: str
    motion: Motion
    scene: Scene
    noise: float  # px
    sequence: Sequence = SINGLE
    points: Points = CLEAN
    calibration: Calibration = EXACT
    camera: Camera = WIDE
    settings: tuple[tuple[str, Any], ...] = ()


REST, HAND = moving("rest"), moving("hand")
SEEN: dict[str, Scene] = {"rich": Rich(), "wall": Wall()}
SLOW_HAND = moving("hand", slower=4.0)  # 17 deg/s
FILMING = moving("hand", slower=67.0 / 12.0)  # 12 deg/s, as one who films a board
# A field of view of 45 degrees, as in the experiments of Kukelova et al. (ACCV 2018).
NARROW = Camera(width=1000, height=1000, focal=1207.0)
GLOBAL = Camera(readout_time=0.0)
_WRONG_READOUT = 0.02  # s, that a user sets for a global shutter
_FEWEST_INLIERS = 12  # that are accepted


def turning(degrees: float) -> Motion:
    """Steady, by so much during a readout; and 10 mm for every degree."""
    readout = NARROW.readout_time
    return moving("steady", rate=np.radians(degrees) / readout, speed=0.01 * degrees / readout)


def _recorded(file: Path, count: int, rng: np.random.Generator) -> Moving:
    return motions.Recorded(np.loadtxt(file), count, rng, around=0.5)


RECORDED = {
    "recorded_hand": partial(_recorded, data.path(data.HAND_MOTION)),
    "recorded_slow": partial(_recorded, SLOW_HAND_MOTION),
}


def conditions() -> Iterator[Condition]:
    """All of them."""
    for bench, make in BENCHES.items():
        for name, motion, scene, noise, *others in make():
            yield Condition(bench, name, motion, scene, noise, **(others[0] if others else {}))


def named(name: str) -> Condition:
    """The condition ``bench/name``."""
    (found,) = (one for one in conditions() if f"{one.bench}/{one.name}" == name)
    return found


def _hand() -> Iterator[tuple[Any, ...]]:
    for n, wrong, noise in product((20, 50, 150), (0.0, 0.3, 0.5), (0.1, 0.3, 1.0, 3.0)):
        if n * (1.0 - wrong) >= _FEWEST_INLIERS:
            name = f"{n}points/{wrong:.0%}wrong/{noise:g}px"
            yield name, HAND, Rich(n), noise, {"points": Points(wrong=wrong)}


def _grid() -> Iterator[tuple[Any, ...]]:
    moves = {
        "rest": REST,
        "hand": HAND,
        "drone": moving("vibration", degrees=0.1, hertz=20.0),
        # Within the second of the five counted frames, so that what follows it counts as well.
        "stop": moving("sudden_stop", earliest=0.0, latest=0.03),
    }
    scenes: dict[str, Scene] = {
        "rich": Rich(), "wall": Wall(), "plane": SmallPlane(), "board": Board()
    }  # fmt: skip
    for (name, motion), (where, scene), noise, (end, sequence) in product(
        moves.items(), scenes.items(), (0.05, 0.3, 1.0, 3.0), _BOTH
    ):
        yield f"{name}/{where}/{noise:g}px{end}", motion, scene, noise, {"sequence": sequence}


def _few() -> Iterator[tuple[Any, ...]]:
    for n, wrong, noise, (name, motion) in product(
        (13, 16, 30), (0.0, 0.2), (0.3, 1.0), (("hand", HAND), ("rest", REST))
    ):
        if n * (1.0 - wrong) >= _FEWEST_INLIERS:
            label = f"{name}/{n}points/{wrong:.0%}wrong/{noise:g}px"
            yield label, motion, Rich(n), noise, {"points": Points(wrong=wrong)}


def _many() -> Iterator[tuple[Any, ...]]:
    for n, (scene, make), noise, (name, motion) in product(
        (1000, 5000), (("rich", Rich), ("wall", Wall)), (0.1, 1.0), (("hand", HAND), ("rest", REST))
    ):
        yield f"{name}/{scene}/{n}points/{noise:g}px", motion, make(n), noise


def _planes() -> Iterator[tuple[Any, ...]]:
    for size, tilt, turn, noise in product(
        (0.2, 0.6, 2.0), (0.0, 10.0, 20.0, 30.0, 60.0), (0.0, 3.0, 10.0), (1.0, 3.0)
    ):
        plane = SmallPlane(size, 2.0 if size < 1.0 else 3.0, tilt)
        label = f"{size:g}m/tilt {tilt:g}/{turn:g}deg/{noise:g}px"
        yield label, turning(turn), plane, noise, {"camera": NARROW}


def _gyro() -> Iterator[tuple[Any, ...]]:
    for size, tilt, turn, noise in product((0.2, 0.6), (0.0, 20.0), (0.0, 10.0), (1.0, 3.0)):
        plane = SmallPlane(size, 2.0, tilt)
        label = f"{size:g}m/tilt {tilt:g}/{turn:g}deg/{noise:g}px"
        others = {"camera": NARROW, "points": Points(gyroscope=True)}
        yield label, turning(turn), plane, noise, others


def _sine() -> Iterator[tuple[Any, ...]]:
    for degrees, hertz, noise in product(
        (0.1, 0.3, 1.0), (5.0, 10.0, 20.0, 50.0, 100.0, 200.0), (0.3, 1.0)
    ):
        shaken = moving("vibration", degrees=degrees, hertz=hertz)
        yield f"{degrees:g}deg/{hertz:g}Hz/{noise:g}px", shaken, Rich(), noise
    for degrees, hertz, noise in product((0.1, 1.0), (20.0, 100.0), (0.3, 1.0)):
        shaken = moving("vibration", degrees=degrees, hertz=hertz)
        label = f"{degrees:g}deg/{hertz:g}Hz/{noise:g}px/tracked"
        yield label, shaken, Rich(), noise, {"sequence": TRACKED}
    for sizes, n, wrong, noise in product(((0.1, 0.3), (0.3, 1.0)), (30, 60), (0.0, 0.5), (0.5,)):
        shaken = moving("any_vibration", degrees=sizes, hertz=(20.0, 200.0))
        label = f"{sizes[0]:g}-{sizes[1]:g}deg/{n}points/{wrong:.0%}wrong/{noise:g}px"
        yield label, shaken, Rich(n), noise, {"points": Points(wrong=wrong)}


def _bands() -> Iterator[tuple[Any, ...]]:
    for tones, degrees, n, noise in product((3, 5, 7), (0.1, 0.3, 1.0), (20, 40, 80), (0.3, 1.0)):
        label = f"{tones}tones/{degrees:g}deg/{n}points/{noise:g}px"
        wrong = Points(wrong=0.2)
        yield label, _band(tones, degrees), Rich(n), noise, {"points": wrong}
    for degrees, noise in product((0.1, 0.3, 1.0), (0.3, 1.0)):
        label = f"5tones/{degrees:g}deg/80points/{noise:g}px/tracked"
        yield label, _band(5, degrees), Rich(), noise, {"sequence": TRACKED}
        yield f"5tones/{degrees:g}deg/wall/{noise:g}px", _band(5, degrees), Wall(), noise


def _band(tones: int, degrees: float) -> Motion:
    """Tones of the same size about other axes, together of this amplitude."""
    each = degrees / tones**0.5
    return moving("any_vibration", degrees=(each, each), hertz=(30.0, 150.0), tones=tones)


def _noise() -> Iterator[tuple[Any, ...]]:
    for degrees, n, noise in product((0.05, 0.1, 0.3, 1.0), (20, 40, 80), (0.3, 1.0)):
        shaken = moving("coloured", degrees=degrees, hertz=(20.0, 200.0))
        label = f"{degrees:g}deg/{n}points/{noise:g}px"
        yield label, shaken, Rich(n), noise, {"points": Points(wrong=0.2)}
    for degrees, noise in product((0.05, 0.1, 0.3, 1.0), (0.3, 1.0)):
        shaken = moving("coloured", degrees=degrees, hertz=(20.0, 200.0))
        label = f"{degrees:g}deg/80points/{noise:g}px/tracked"
        yield label, shaken, Rich(), noise, {"sequence": TRACKED}


def _impacts() -> Iterator[tuple[Any, ...]]:
    for degrees, noise in product((0.1, 0.3, 1.0), (0.3, 1.0)):
        hit = moving("struck", degrees=degrees, earliest=-0.04, latest=0.01)
        yield f"{degrees:g}deg/{noise:g}px", hit, Rich(), noise
        # Before the first of the frames that count.
        hit = moving("struck", degrees=degrees, earliest=-0.02, latest=0.04)
        yield f"{degrees:g}deg/{noise:g}px/tracked", hit, Rich(), noise, {"sequence": TRACKED}


def _real() -> Iterator[tuple[Any, ...]]:
    for which, noise, tracked in product(("hand", "slow"), (0.1, 0.3, 1.0), (False, True)):
        label = f"{which}/{noise:g}px{'/tracked' * tracked}"
        sequence = Sequence(20, (5, 20)) if tracked else SINGLE
        yield label, moving(f"recorded_{which}"), Rich(), noise, {"sequence": sequence}


def _student() -> Iterator[tuple[Any, ...]]:
    for tails, scene, noise in product((3.0, 5.0), ("rich", "wall"), (0.3, 1.0)):
        others = {"points": Points(tails=tails)}
        yield f"{tails:g} degrees/{scene}/{noise:g}px", HAND, SEEN[scene], noise, others


def _shared() -> Iterator[tuple[Any, ...]]:
    for scene, noise, (end, sequence) in product(("rich", "wall"), (0.3, 1.0), _BOTH):
        others = {"points": Points(shift=0.3), "sequence": sequence}
        yield f"{scene}/{noise:g}px{end}", HAND, SEEN[scene], noise, others


def _body() -> Iterator[tuple[Any, ...]]:
    for (name, motion), noise, (end, sequence) in product(
        (("hand", HAND), ("rest", REST)), (0.3, 1.0), _BOTH
    ):
        others = {"points": Points(body=1.0 / 3.0), "sequence": sequence}
        yield f"{name}/{noise:g}px{end}", motion, Rich(), noise, others


def _camera() -> Iterator[tuple[Any, ...]]:
    errors = {
        "centre 1px": Calibration(centre=1.0),
        "focal 0.1%": Calibration(focal=0.001),
        "focal 0.3%": Calibration(focal=0.003),
        "lens 10%": Calibration(distortion=0.1),
        "lens 30%": Calibration(distortion=0.3),
        "ten boards": Calibration(boards=10),
    }
    for (error, calibration), scene, noise, (end, sequence) in product(
        errors.items(), ("rich", "wall"), (0.3, 1.0), _BOTH
    ):
        others = {"calibration": calibration, "sequence": sequence}
        yield f"{error}/{scene}/{noise:g}px{end}", HAND, SEEN[scene], noise, others


def _map() -> Iterator[tuple[Any, ...]]:
    maps = (
        ("perfect", CLEAN), ("bent 1cm", Points(bent_map=0.01)),
        ("rough 1cm", Points(rough_map=0.01)),
    )  # fmt: skip
    for (name, points), scene, noise, (end, sequence) in product(
        maps, ("rich", "wall"), (0.3, 1.0), _BOTH
    ):
        settings = (("map_deviation", 0.01),)
        others = {"points": points, "settings": settings, "sequence": sequence}
        yield f"{name}/{scene}/{noise:g}px{end}", HAND, SEEN[scene], noise, others


def _locks() -> Iterator[tuple[Any, ...]]:
    for size, tilt, noise in product((0.2, 0.6), (0.0, 20.0), (1.0, 3.0)):
        plane = SmallPlane(size, 1.6, tilt)
        others = {"sequence": Sequence(30, (10, 30))}
        yield f"{size:g}m/tilt {tilt:g}/{noise:g}px", SLOW_HAND, plane, noise, others


def _bad() -> Iterator[tuple[Any, ...]]:
    for scene, shift, noise in product(("rich", "wall"), (4.0, 15.0), (0.3, 1.0)):
        others = {"sequence": Sequence(18, (13, 18), (10, 13, shift))}
        yield f"{scene}/shift {shift:g}px/{noise:g}px", HAND, SEEN[scene], noise, others


def _alike() -> Iterator[tuple[Any, ...]]:
    for (name, motion), share, shift in product(
        (("rest", REST), ("hand", HAND)), (0.15, 0.25, 0.4), (3.0, 8.0, 15.0, 25.0)
    ):
        others = {"points": Points(alike=(share, shift))}
        yield f"{name}/{share:.0%}/{shift:g}px", motion, Rich(), 0.5, others


def _axis() -> Iterator[tuple[Any, ...]]:
    for (name, motion), noise, late in product(
        (("hand", HAND), ("slow", SLOW_HAND)), (0.3, 1.0), (False, True)
    ):
        others = {
            "camera": Camera(scan=Scan.RIGHT),
            "calibration": Calibration(scan=Scan.DOWN),
            # From two seconds on, when it has to be known.
            "sequence": Sequence(75, (60, 75)) if late else SINGLE,
        }
        yield f"{name}/{noise:g}px{'/after 2s' * late}", motion, Rich(), noise, others


def _global() -> Iterator[tuple[Any, ...]]:
    calibration = Calibration(readout_time=_WRONG_READOUT)
    for (name, scene), noise, (end, sequence) in product(
        (("rich", Rich()), ("board", Board())), (0.1, 0.5), _BOTH
    ):
        others = {"camera": GLOBAL, "calibration": calibration, "sequence": sequence}
        yield f"{name}/{noise:g}px{end}", SLOW_HAND, scene, noise, others


def _boards() -> Iterator[tuple[Any, ...]]:
    # Share of the distortion that the calibration lacks, and bend (m) that the map does not know.
    lenses = [(lens, 0.0) for lens in (0.0, 0.1, 0.3)]
    faults = [*lenses, (0.0, 2e-4), (0.0, 5e-4), (0.0, 2e-3), (0.1, 5e-4)]
    for markers, (lens, bend), noise, readout, told in product(
        (False, True), faults, (0.1, 0.5), (0.0, 0.005, 0.011, 0.03), ("unset", "set", "tracked")
    ):
        if told == "tracked" and readout == 0.0:
            continue
        believed = 0.0 if told == "unset" else readout or _WRONG_READOUT
        others = {
            "camera": Camera(readout_time=readout),
            "calibration": Calibration(distortion=lens, readout_time=believed),
            "sequence": TRACKED if told == "tracked" else SINGLE,
        }
        label = f"{'markers' if markers else 'board'}/lens {lens:.0%}/bend {1e3 * bend:g}mm"
        label += f"/{noise:g}px/{1e3 * readout:g}ms/{told}"
        yield label, FILMING, Board(markers, bend), noise, others


BENCHES: dict[str, Callable[[], Iterator[tuple[Any, ...]]]] = {
    "hand": _hand, "grid": _grid, "few": _few, "many": _many, "planes": _planes, "gyro": _gyro,
    "locks": _locks, "sine": _sine, "bands": _bands, "noise": _noise, "impacts": _impacts,
    "real": _real, "student": _student, "shared": _shared, "body": _body, "camera": _camera,
    "map": _map, "bad": _bad, "alike": _alike, "axis": _axis, "global": _global, "boards": _boards,
}  # fmt: skip
"""By name, of which ``run --bench`` takes some."""
