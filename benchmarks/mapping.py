# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How good refined and built maps and surveyed markers are, on simulated rooms of known truth:

python -m benchmarks.mapping bend surveys walks
"""

import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks import command
from benchmarks.aided import believed
from benchmarks.frames.judged import FIVE_SIGMA, REGION
from benchmarks.independent import cameras
from benchmarks.independent.rotations import Array, exponential, logarithm
from rs_localizer.cli.options import number
from rs_localizer.config import NodeConfig
from rs_localizer.estimation.calibration import ErrorModes
from rs_localizer.features.extraction import Features
from rs_localizer.localizer import Localizer
from rs_localizer.markers import prints
from rs_localizer.markers.families import family
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Marker
from rs_localizer.tools.mapping.anchors import Anchors
from rs_localizer.tools.mapping.build import Built, Given, built_from
from rs_localizer.tools.mapping.gauge import scaled, through
from rs_localizer.tools.mapping.map_keypoints import MapFreedom, MapObservations, Start
from rs_localizer.tools.mapping.refinement import refine
from rs_localizer.tools.mapping.structure import SeenImage, Structure
from rs_localizer.tools.mapping.survey import Survey, survey
from rs_localizer.tools.mapping.unknown_markers import Filmed, Spotted
from rs_localizer.tracking import FrameContext, Tracker

_HALF = 2.5  # m, of the room
_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_STEEPEST = 0.35  # cosine of the angle at which markers are still seen
_LEAST_SIDE = 12.0  # px
_NOISE, _MARKER_NOISE, _OFF = 0.3, 0.1, 0.02  # px, px, m
_CAMERA = cameras.Camera()
_READOUT = _CAMERA.readout_time  # s
_FAMILY = "4x4_50"
_START_NS = 10**12

Pose = tuple[Array, Array]
"""map_from_marker (3,3), (3,)."""


@dataclass(frozen=True, slots=True, eq=False)
class Walk:
    """A hand-held camera that goes round in the middle of the room and looks outward."""

    phases: Array  # (12,)
    turning: float  # rad/s
    wide: float = 1.2  # m
    returns: float = np.inf  # s, after which it is back where it began, by the same way

    def poses(self, times: Array) -> tuple[Array, Array]:
        """map_from_camera (n,3,3), (n,3) at times (n,), s; y of the map points down."""
        t, p = np.asarray(times, float), self.phases
        if np.isfinite(self.returns):
            t = self.returns / np.pi * np.sin(np.pi * t / self.returns) ** 2
        place = np.column_stack([
            self.wide * np.cos(0.4 * t + p[0]) + 0.03 * np.sin(5.0 * t + p[1]),
            0.2 * np.sin(0.6 * t + p[2]) + 0.02 * np.sin(7.0 * t + p[3]),
            self.wide * np.sin(0.5 * t + p[4]) + 0.03 * np.sin(6.0 * t + p[5]),
        ])  # fmt: skip
        about = np.zeros((3, len(t), 3))
        about[0, :, 1] = self.turning * t + 0.06 * np.sin(5.0 * t + p[6])
        about[1, :, 0] = 0.25 * np.sin(0.7 * t + p[7]) + 0.05 * np.sin(8.0 * t + p[8])
        about[2, :, 2] = 0.1 * np.sin(0.9 * t + p[9]) + 0.04 * np.sin(6.0 * t + p[10])
        turn = exponential(about[0]) @ exponential(about[1]) @ exponential(about[2])
        return turn, place


def _walk(rng: np.random.Generator, turning: float, wide: float = 1.2) -> Walk:
    return Walk(rng.uniform(0.0, 2.0 * np.pi, 12), turning, wide)


def _walls(rng: np.random.Generator, count: int) -> Array:
    """Points (count,3) on the six sides of the room."""
    points = rng.uniform(-_HALF, _HALF, (count, 3))
    points[np.arange(count), rng.integers(0, 3, count)] = _HALF * rng.choice([-1.0, 1.0], count)
    return points


@dataclass(frozen=True, slots=True, eq=False)
class Film:
    """Images of a walk."""

    camera: cameras.Camera
    walk: Walk
    stamps: Array  # (g,) s, of the first rows

    def see(self, points: Array, rng: np.random.Generator, most: int) -> MapObservations:
        """Keypoints of points (p,3), so many of an image at most."""
        images, landmarks, pixels = [], [], []
        for g, shown in enumerate(self._shown(points)):
            found = rng.permutation(np.flatnonzero(np.isfinite(shown[:, 0])))[:most]
            images.append(np.full(len(found), g))
            landmarks.append(found)
            pixels.append(shown[found] + rng.normal(0.0, _NOISE, (len(found), 2)))
        return MapObservations(
            _START_NS + np.round(1e9 * self.stamps).astype(np.int64),
            *map(np.concatenate, (images, landmarks, pixels)),
        )

    def near(self, points: Array, rng: np.random.Generator) -> Start:
        """A first guess that is off the truth."""
        rotations, places = self.walk.poses(self.stamps + 0.5 * self.camera.readout_time)
        return Start(
            points + rng.normal(0.0, _OFF, points.shape),
            rotations @ exponential(rng.normal(0.0, 0.25 * _OFF, (len(rotations), 3))),
            places + rng.normal(0.0, _OFF, places.shape),
        )

    def spot(self, poses: list[Pose], size: float, rng: np.random.Generator) -> list[Spotted]:
        """The markers that images show whole, large and not too slanted."""
        corners = np.concatenate([size * _SQUARE @ turn.T + place for turn, place in poses])
        normals = np.array([turn[:, 2] for turn, _ in poses])
        middles = np.array([place for _, place in poses])
        spotted = []
        for stamp, pixels in zip(self.stamps.tolist(), self._shown(corners), strict=True):
            quads = pixels.reshape(-1, 4, 2)
            toward = self.walk.poses(np.array([stamp]))[1][0] - middles
            slant = np.einsum("ni,ni->n", toward, normals) / np.linalg.norm(toward, axis=1)
            side = np.linalg.norm(np.roll(quads, 1, axis=1) - quads, axis=2).min(axis=1)
            with np.errstate(invalid="ignore"):
                seen = np.flatnonzero((slant > _STEEPEST) & (side > _LEAST_SIDE))
            found = quads[seen] + rng.normal(0.0, _MARKER_NOISE, (len(seen), 4, 2))
            spotted.append(Spotted(_START_NS + round(1e9 * stamp), seen, found))
        return spotted

    def _shown(self, points: Array) -> Iterator[Array]:
        """Pixels (p,2) of points in each image; NaN for those that it does not show."""
        size = np.array([self.camera.width, self.camera.height]) - 1.0
        for stamp in self.stamps.tolist():
            rotation, place = self.walk.poses(np.array([stamp]))
            local = (points - place) @ rotation[0]
            # What lies far outside is folded back by the lens's polynomial.
            ahead = np.flatnonzero(np.abs(local[:, :2]).max(axis=1) < local[:, 2])

            def local_at(delay: Array, stamp: float = stamp, those: Array = points[ahead]) -> Array:
                rotations, places = self.walk.poses(stamp + delay)
                return np.asarray(np.einsum("nji,nj->ni", rotations, those - places))

            pixels = self.camera.project_rolling(local_at, (len(ahead),))
            with np.errstate(invalid="ignore"):
                inside = np.all((pixels > 1.0) & (pixels < size - 1.0), axis=1)
            shown = np.full((len(points), 2), np.nan)
            shown[ahead[inside]] = pixels[inside]
            yield shown


def bend(seed: int) -> Iterator[str]:
    """Errors of one map: as given, and adjusted with each shutter."""
    rng = np.random.default_rng(seed)
    walk, points = _walk(rng, 0.6), _walls(rng, 1500)
    film = Film(_CAMERA, walk, np.arange(0.0, 12.0, 1.0 / 15.0))
    seen, start = film.see(points, rng, 80), film.near(points, rng)

    def errors(own: Array) -> str:
        """Of landmarks, but for the whole's place and size."""
        off = through(own[of], points[of])(own[of]) - points[of]
        median, most = 1e3 * np.percentile(np.linalg.norm(off, axis=1), [50.0, 95.0])
        return f"{median:8.2f} {most:8.2f}"

    yield "map refine                   landmarks  median    95 % (mm)  noise (px)  readout (ms)"
    for name, readout, free, offset in (
        ("global", 0.0, False, 0.5 * _READOUT),
        ("rolling, given", _READOUT, False, 0.0),
        ("rolling, found from 20 ms", 0.02, True, 0.0),
    ):
        freedom = MapFreedom(readout_time=free)
        found = refine(believed(_CAMERA, readout), seen, start, freedom, stamp_offset=offset)
        of = found.refined & (found.sights >= 6)
        if not readout:
            yield f"{'as given':28} {np.count_nonzero(of):9} {errors(start.points)}"
        spread = "" if not free else f" +- {1e3 * found.readout_time_deviation:.3f}"
        yield (
            f"{name:28} {np.count_nonzero(of):9} {errors(found.points)} "
            f"{found.after:10.3f}  {1e3 * found.readout_time:.3f}{spread}"
        )


def _inside(normalized: Sequence[Array]) -> str:
    every = np.abs(np.concatenate([np.ravel(one) for one in normalized]))
    return f"{100.0 * np.mean(every < 1.96):.0f}"


def ring(rng: np.random.Generator, count: int) -> list[Pose]:
    """Markers all around the room, hung by hand."""
    poses = []
    for k in range(count):
        angle = 2.0 * np.pi * (k + rng.uniform(-0.2, 0.2)) / count
        outward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        place = 2.2 * outward + [0.0, rng.uniform(-0.4, 0.4), 0.0]
        up = np.array([0.0, -1.0, 0.0])
        turn = np.column_stack([np.cross(up, -outward), up, -outward])
        poses.append((turn @ exponential(rng.normal(0.0, 0.15, (1, 3)))[0], place))
    return poses


def grid(columns: int, rows: int, pitch: float) -> list[Pose]:
    """A printed wall before the camera's place at rest."""
    x, y = np.arange(columns) - 0.5 * (columns - 1), np.arange(rows) - 0.5 * (rows - 1)
    facing = np.diag([1.0, -1.0, -1.0])
    return [(facing, np.array([pitch * u, pitch * v, 1.0])) for v in y for u in x]


_WALLS = {"printed wall 3x2 of 0.06 m": True, "12 of 0.15 m around a room": False}
"""Scenes of surveys, and whether they are a printed wall."""


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Of all markers of one survey: in the frame of the first one, and of the shape."""

    off: tuple[Array, Array]  # (m,6) m and rad
    normalized: tuple[Array, Array]  # (m,6) each coordinate by its own deviation
    squared: float  # mean squared error by the own covariance


def surveys(seed: int, trials: int = 3) -> Iterator[str]:
    """Errors of the markers and what they are told to be, where corners have white noise."""
    yield (
        f"{'map survey':28} first marker: mm, deg  shape: mm, deg  inside 95 %  over own deviation"
    )
    for scene, wall in _WALLS.items():
        found = [_survey(wall, [seed, trial]) for trial in range(trials)]
        cells = []
        for k in range(2):
            off = np.concatenate([one.off[k] for one in found])
            place, turn = (np.median(np.linalg.norm(x, axis=1)) for x in np.split(off, 2, axis=1))
            cells.append(f"{1e3 * place:8.2f} {np.degrees(turn):7.3f}")
        inside = ", ".join(_inside([one.normalized[k] for one in found]) for k in range(2))
        own = np.sqrt(np.mean([one.squared for one in found]))
        yield f"{scene:28}    {cells[0]} {cells[1]}     {inside}               {own:.2f}"


def _survey(wall: bool, seeds: list[int]) -> _Errors:
    rng = np.random.default_rng(seeds)
    walk = _walk(rng, 0.0, 0.15) if wall else _walk(rng, 0.6, 0.5)
    poses = grid(3, 2, 0.08) if wall else ring(rng, 12)
    size = 0.06 if wall else 0.15
    film = Film(_CAMERA, walk, np.arange(0.0, 30.0, 1.0 / 30.0))
    camera = believed(_CAMERA)
    filmed = Filmed(camera, film.spot(poses, size, rng))
    count = family(_FAMILY).count
    found = survey(filmed, [Marker.at(_FAMILY, id_, size, prints.Pose()) for id_ in range(count)])
    turn, origin = poses[found.markers[0].id]
    true = [(turn.T @ poses[m.id][0], turn.T @ (poses[m.id][1] - origin)) for m in found.markers]
    off = _off(found, true, np.eye(3), np.zeros(3))
    squares = np.concatenate([size * _SQUARE @ axes.T + place for axes, place in true])
    ours = np.concatenate([marker.corners for marker in found.markers])
    back = Rotation.align_vectors(squares - squares.mean(axis=0), ours - ours.mean(axis=0))[0]
    over = back.as_matrix()
    shape = _off(found, true, over, squares.mean(axis=0) - over @ ours.mean(axis=0))
    own = off[1:].ravel()
    squared = float(own @ np.linalg.solve(found.covariance[6:, 6:], own)) / len(own)
    spread = np.sqrt(np.diagonal(found.covariance)).reshape(-1, 6)[1:]
    normalized = off[1:] / spread, shape / found.deviations_of_shape
    return _Errors((off[1:], shape), normalized, squared)


def _off(found: Survey, true: list[Pose], turn: Array, shift: Array) -> Array:
    """Errors (m,6) of places and turns after a motion of the whole."""
    return np.array([
        np.concatenate([
            turn @ marker.pose.position + shift - place,
            Rotation.from_matrix(turn @ marker.pose.rotation @ axes.T).as_rotvec(),
        ])
        for marker, (axes, place) in zip(found.markers, true, strict=True)
    ])  # fmt: skip


_WALKS = {
    "6 s, does not return": (6.0, False, 0),
    "6 s, returns": (6.0, True, 0),
    "6 s, on, some markers": (6.0, False, 12),
    "12 s, does not return": (12.0, False, 0),
    "30 s, returns": (30.0, True, 0),
}
"""Length (s) of a walk, whether it comes back, and markers that hang around the room."""
_HELD_OUT = 2.0  # s before the walk and after it


def walks(seed: int) -> Iterator[str]:
    """Errors of poses in maps from walks, in the seconds before and after the walk.

    COLMAP's part is left out: a first guess takes its place, whose landmarks are 2 cm off.
    """
    yield (
        f"{'map build':22} landmarks  off (mm)  share (mm)  poses  error  claimed (mm)  "
        "inside %  >5"
    )
    for name, (seconds, returns, markers) in _WALKS.items():
        rng = np.random.default_rng([seed, *name.encode()])
        walk = replace(_walk(rng, 0.3), returns=seconds if returns else np.inf)
        room = _walls(rng, 3000)
        film = Film(_CAMERA, walk, np.arange(0.0, seconds, 1.0 / 15.0))
        built = _built(film, room, markers, rng)
        true, lies = room[built.kept], through(built.landmarks.points, room[built.kept])
        lies = scaled(1.0) if markers else lies
        off = np.linalg.norm(lies(built.landmarks.points) - true, axis=1)
        assert built.landmarks.error_modes is not None
        modes = np.asarray(lies.scale * lies.rotation @ built.landmarks.error_modes)
        landmarks = ErrorModes(lies(built.landmarks.points), modes)
        shared = np.linalg.norm(modes, axis=(1, 2))
        found: list[tuple[float, float, float]] = []
        for start in (-_HELD_OUT, seconds):
            film = Film(_CAMERA, walk, start + np.arange(0.0, _HELD_OUT, 1.0 / 30.0))
            found += _localized(film, true, lies(built.landmarks.points), landmarks, rng)
        error, claimed, squared = np.array(found).T
        yield (
            f"{name:22} {len(true):9} {1e3 * np.median(off):9.1f} {1e3 * np.median(shared):11.1f} "
            f"{len(found):6} {1e3 * np.median(error):6.1f} {1e3 * np.median(claimed):13.1f} "
            f"{100.0 * np.mean(squared < REGION):9.0f} "
            f"{np.count_nonzero(squared > FIVE_SIGMA):3}"
        )


def _built(film: Film, room: Array, markers: int, rng: np.random.Generator) -> Built:
    """Build a map of what a film sees, and of markers around the room."""
    seen, start, count = film.see(room, rng, 100), film.near(room, rng), len(film.stamps)
    none = np.zeros((0, 2)), np.zeros(0, np.int64)
    shown, anchors = [none] * count, Anchors()
    if markers:
        poses = ring(rng, markers)
        corners = [0.25 * _SQUARE @ turn.T + place for turn, place in poses]
        own = family(_FAMILY)
        every = tuple(Marker(own, k, quad, None) for k, quad in enumerate(corners))
        anchors = Anchors(MarkerMap(every))
        shown = [
            (one.quads.reshape(-1, 2), (4 * one.markers[:, None] + np.arange(4)).ravel())
            for one in film.spot(poses, 0.25, rng)
        ]
    nothing, camera = Path(), believed(_CAMERA)
    none_found = np.zeros(0)
    features = Features(np.zeros((0, 2)), none_found, none_found, np.zeros((0, 1), np.float32))
    views = [
        SeenImage(int(stamp), nothing, features, 1.0, *of)
        for stamp, of in zip(seen.stamps_ns, shown, strict=True)
    ]
    rows = np.arange(count)
    inputs = Given(views, camera, anchors, _READOUT, str(camera.scan_direction))
    descriptors = np.zeros((len(room), 1), np.float32)
    structure = Structure(rows, seen, start, descriptors, camera, (count,))
    return built_from(inputs, structure, (rows, seen, start), camera)


def _localized(
    film: Film, true: Array, points: Array, modes: ErrorModes, rng: np.random.Generator
) -> Iterator[tuple[float, float, float]]:
    """Localize images on a map: error and deviation (m) of the place, squared error of the pose."""
    tracker = Tracker(Localizer(believed(_CAMERA), NodeConfig()))
    seen, context = film.see(true, rng, 100), FrameContext(error_modes=modes)
    for image, stamp in enumerate(film.stamps.tolist()):
        of = seen.images == image
        found = tracker.localize(
            int(seen.stamps_ns[image]), points[seen.landmarks[of]], seen.pixels[of],
            context=context,
        )  # fmt: skip
        if found:
            rotation, place = film.walk.poses(np.array([stamp + 0.5 * _READOUT]))
            away = found.rotation @ (found.position - place[0])
            turn = logarithm(np.swapaxes(rotation, 1, 2) @ found.rotation.T)[0]
            own, off = found.covariance[:6, :6], np.r_[turn, away]
            deviation = float(np.sqrt(np.trace(own[3:, 3:])))
            yield float(np.linalg.norm(away)), deviation, float(off @ np.linalg.solve(own, off))


_PARTS: dict[str, Callable[[int], Iterator[str]]] = {
    "bend": bend, "surveys": surveys, "walks": walks
}  # fmt: skip


def main() -> int:
    parser = command(".mapping", __doc__)
    parser.add_argument("names", nargs="+", metavar="PART", choices=_PARTS, help=", ".join(_PARTS))
    parser.add_argument("--seed", type=number(0, kind=int), default=0, metavar="N")
    options = parser.parse_args()
    for name in options.names:
        for text in _PARTS[name](options.seed):
            print(text, flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
