# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Markers surveyed: a printed wall, and twelve around a room, by one camera and by a rig."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from benchmarks.independent.cameras import Camera, Scan
from benchmarks.independent.rotations import exponential
from benchmarks.mapping.rooms import (
    SQUARE,
    Carried,
    Film,
    Walk,
    a_walk,
    estimators_camera,
    grid,
    ring,
)
from rs_localizer.core.arrays import Array
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.families import Family, family
from rs_localizer.tools.adjust.fit import Fit
from rs_localizer.tools.adjust.problem import LIMIT
from rs_localizer.tools.adjust.variables import Extrinsics, Mounting
from rs_localizer.tools.mapping.survey import Survey, survey, survey_rig
from rs_localizer.tools.mapping.unknown_markers import Filmed, Spotted, Spotter, every_marker
from rs_localizer.tools.simulation.renderer import Renderer
from rs_localizer.tools.simulation.settings import ImageSettings
from rs_localizer.tools.simulation.true_motion import TrueState
from rs_localizer.tools.simulation.walls import PAPER_AND_INK, TexturedPlane, printed

_CELL_TEXELS = 24
_GREY_NOISE = 2.0
# What lies within this of the picture's edges may reach into it (tangent).
_MARGIN = 0.3
_STEP = 1e-4  # s, of velocities


@dataclass(frozen=True, slots=True)
class Lighting:
    """How long each row is exposed."""

    exposure: float  # s


class _Walking:
    """A walk as the renderer asks for it."""

    def __init__(self, walk: Walk | Carried, seconds: float) -> None:
        self._walk = walk
        self.intervals_ns = [(0, round(1e9 * seconds))]

    def state(self, stamp_ns: int, offsets: Array) -> TrueState:
        times = 1e-9 * stamp_ns + np.asarray(offsets, float)
        turns, places = self._walk.poses(times)
        later, there = self._walk.poses(times + _STEP)
        rate = np.einsum("nji,njk->nik", turns, later - turns) / _STEP
        return TrueState(
            turns,
            places,
            np.stack([rate[:, 2, 1], rate[:, 0, 2], rate[:, 1, 0]], axis=1),
            np.einsum("nji,nj->ni", turns, there - places) / _STEP,
        )


def rendered_spots(
    film: Film, poses: list[tuple[Array, Array]], size: float, name: str, lighting: Lighting
) -> list[Spotted]:
    """The markers that the detector finds in each image; poses are map_from_marker."""
    camera = estimators_camera(film.camera, film.camera.readout_time)
    prints = [_hung(family(name), k, pose, size) for k, pose in enumerate(poses)]
    middles = np.array([place for _, place in poses])
    settings = ImageSettings(lighting.exposure, _GREY_NOISE)
    walking = _Walking(film.walk, float(film.stamps[-1]) + 1.0)
    spotter = Spotter(every_marker([family(name)], size, {}))
    renderers: dict[tuple[int, ...], Renderer] = {}
    spotted = []
    for k, stamp in enumerate(film.stamps.tolist()):
        turns, places = film.walk.poses(np.array([stamp]))
        local = (middles - places[0]) @ turns[0]
        limit = local[:, 2] * (0.5 * film.camera.width / film.camera.focal + _MARGIN) + _MARGIN
        shown = tuple(np.flatnonzero(np.abs(local[:, :2]).max(axis=1) < limit).tolist())
        if not shown:
            continue
        if shown not in renderers:  # planes that are not seen take time, too
            renderers[shown] = Renderer(camera, [prints[i] for i in shown], settings)
        image = renderers[shown].image(walking, round(1e9 * stamp), (k,))
        spotted.append(spotter.spot(image, 10**12 + round(1e9 * stamp)))
    return spotted


def _hung(of: Family, number: int, pose: tuple[Array, Array], size: float) -> TexturedPlane:
    """A marker with a white rim of a cell."""
    axes, place = pose
    white = np.pad(pattern(of, number), 1, constant_values=True)
    texture = printed(white, PAPER_AND_INK, _CELL_TEXELS)
    texel = size / (of.cells * _CELL_TEXELS)
    half = 0.5 * texel * len(texture)
    corner = place - half * axes[:, 0] + half * axes[:, 1]
    return TexturedPlane(corner, axes[:, 0], -axes[:, 1], texel, texture)


FAMILY = "4x4_50"
_NOISE = 0.1  # px
_SMALL, _LARGE = Camera(), Camera(width=1280, height=960, focal=840.0)


@dataclass(frozen=True, slots=True)
class _Scene:
    name: str
    camera: Camera = _SMALL
    walls: bool = False
    seconds: float = 30.0
    wide: float = 0.5  # m, of the walk
    rate: float = 30.0  # Hz


_SCENES = (
    _Scene("printed wall 3x2 of 0.06 m, VGA", walls=True),
    _Scene("12 of 0.15 m around a room, VGA"),
    _Scene("the same, a minute, up to the walls", seconds=60.0, wide=1.2),
    _Scene("12 around a room, 1280x960", _LARGE),
)
_RENDERED = (
    (_Scene("printed wall, rendered, 2 ms", walls=True, seconds=6.0), Lighting(0.002)),
    (_Scene("12 around a room, rendered, 2 ms", seconds=15.0), Lighting(0.002)),
    (_Scene("12 around a room, rendered, 8 ms", seconds=12.0), Lighting(0.008)),
)
_HEAD = (
    "scene                                markers    mm     deg  shape: mm    deg  "
    "in 3: frame, shape (%)  by own deviations  T off by its own"
)


def surveys(seed: int, trials: int = 3) -> Iterator[str]:
    """Errors of the markers and what they are told to be, where corners have white noise."""
    yield f"{_HEAD}  by the bound"
    for scene in _SCENES:
        found = [_one(scene, [seed, trial], None) for trial in range(trials)]
        bound = np.sqrt(np.mean([error.squared_by_bound for error in found]))
        yield f"{_line(scene, found)} {bound:13.2f}"


def rendered(seed: int, trials: int = 3) -> Iterator[str]:
    """The same with corners that were found in rendered images."""
    yield _HEAD
    for scene, lighting in _RENDERED:
        yield _line(scene, [_one(scene, [seed, trial], lighting) for trial in range(trials)])


def coverage(seed: int, trials: int = 40) -> Iterator[str]:
    """How many of the truths lie inside the regions of many rooms, the readout time given and found
    by turns.
    """
    scene = _Scene("12 of 0.15 m around a room", seconds=12.0, rate=15.0)
    found: list[_Errors] = []
    yield "rooms  coordinates inside 68, 95, 99.7 %: frame    shape    by own deviations, each room"
    for trial in range(trials):
        found.append(_one(scene, [seed, 1000 + trial], None, known=trial % 2 == 0))
        inside = [
            " ".join(
                f"{_inside(np.concatenate([np.ravel(getattr(e, name)) for e in found]), k):5.1f}"
                for k in (1.0, 1.96, 3.0)
            )
            for name in ("normalised", "normalised_of_shape")
        ]
        squared = np.array([error.squared for error in found])
        yield (
            f"{len(found):5}  {inside[0]}    {inside[1]}    {np.sqrt(np.mean(squared)):.2f} "
            f"({np.sqrt(squared[-1]):.2f})"
        )


# How the second camera of a rig is mounted: it looks back, 10 cm beside the first, against whose
# shutter its own runs; its images begin 7 ms after those of the first.
_BACK = exponential(np.array([[0.1, 3.0, 0.05]]))[0]
_CENTRE, _LATER = np.array([0.1, -0.02, -0.05]), 0.0071
# What its extrinsics are known to: deviations of turn (rad), place (m) and clock (s).
_MOUNTED = np.repeat([1.7e-3, 5e-3, 1.5e-3], [3, 3, 1])
_RIGS = ("one camera", "one camera, twice as many images", "two, back to back")


def rigs(seed: int, trials: int = 12) -> Iterator[str]:
    """A room surveyed by one camera, by one with twice as many images, and by two back to back
    whose extrinsics and clocks are known to 0.1 deg, 5 mm and 1.5 ms.
    """
    scene = _Scene("12 of 0.15 m around a room", seconds=12.0, rate=15.0)
    for walls in (False, True):
        yield "the rig goes round" if not walls else "the rig looks to one side: +-30 deg"
        yield (
            "camera(s)                          rooms markers  mm, deg  shape: mm, deg (medians)  "
            "inside 95 %: frame, shape  mount: off by (mm, deg, ms), inside"
        )
        for name in _RIGS:
            found = [
                one for trial in range(trials) if (one := _rig(scene, name, walls, [seed, trial]))
            ]
            yield _rig_line(name, found) if found else f"{name:36} none"


def _rig(
    scene: _Scene, name: str, aside: bool, seeds: list[int]
) -> tuple[_Errors, Array, Array] | None:
    """Errors of the markers, and those of the mounting with their deviations (7,)."""
    rng = np.random.default_rng(seeds)
    walk = a_walk(rng, 0.0 if aside else 0.6, scene.wide)
    if aside:
        walk = replace(walk, sway=0.5)
    poses, size = ring(rng, 12), 0.15
    rate = scene.rate * (2.0 if "twice" in name else 1.0)
    stamps = np.arange(0.0, scene.seconds, 1.0 / rate)
    markers = every_marker([family(FAMILY)], size, {})
    first, second = scene.camera, replace(scene.camera, readout_time=0.025, scan=Scan.UP)
    filmed = [_filmed(first, walk, stamps, poses, size, rng)]
    true = Extrinsics(_BACK, _CENTRE, 0.0)
    if "two" in name:
        carried = Carried(walk, _BACK, _CENTRE)
        given = true.moved(_MOUNTED * rng.normal(size=7))
        rear = _filmed(second, carried, stamps + _LATER, poses, size, rng)
        filmed.append(
            replace(
                rear,
                stamp_offset=given.offset,
                mounting=Mounting(replace(given, offset=0.0), _MOUNTED),
            )
        )
    try:
        found = survey_rig(filmed, markers)
    except ValueError as error:
        print(f"{name}: {error}")
        return None
    errors = _errors(found, poses, size)
    mount = found.cameras[-1]
    if len(filmed) == 1:
        return errors, np.zeros(0), np.zeros(0)
    off = mount.extrinsics.beside(replace(true, offset=-filmed[1].stamp_offset))
    return errors, off, mount.deviations


def _filmed(
    camera: Camera, walk: Walk | Carried, stamps: Array, poses: list[tuple[Array, Array]],
    size: float, rng: np.random.Generator,
) -> Filmed:  # fmt: skip
    spotted = Film(camera, walk, stamps).spot(poses, size, _NOISE, rng)
    return Filmed(estimators_camera(camera, camera.readout_time), spotted=spotted)


def _rig_line(name: str, found: Sequence[tuple[_Errors, Array, Array]]) -> str:
    def every(of: str) -> Array:
        return np.concatenate([np.ravel(getattr(errors, of)) for errors, _, _ in found])

    frame, shape = (
        f"{np.median(every(f'places{of}')):6.2f} {np.median(every(f'turns{of}')):6.3f}"
        for of in ("", "_of_shape")
    )
    inside = [_inside(every(f"normalised{of}"), 1.96) for of in ("", "_of_shape")]
    text = (
        f"{name:36} {len(found):3} {len(every('places')) / len(found) + 1:6.1f}  {frame}  {shape}  "
        f"{inside[0]:8.1f} {inside[1]:6.1f}"
    )
    off, deviations = (np.array([one[k] for one in found]) for k in (1, 2))
    if off.size:
        turn, place, clock = (
            unit * np.sqrt(np.mean(part**2))
            for unit, part in zip((180.0 / np.pi, 1e3, 1e3), np.split(off, [3, 6], 1), strict=True)
        )
        text += f"  {place:6.2f} {turn:.3f} {clock:.3f}, {_inside(off / deviations, 1.96):.0f} %"
    return text


def _inside(normalised: Array, deviations: float) -> float:
    """Percent of errors within so many of their own deviations."""
    return 100.0 * float(np.mean(np.abs(normalised) < deviations))


@dataclass(frozen=True, slots=True, eq=False)
class _Errors:
    """Of all markers of one survey, but for the origin in its own frame."""

    places: Array  # mm
    turns: Array  # deg
    places_of_shape: Array
    turns_of_shape: Array
    normalised: Array  # (m,6) each coordinate by its own deviation
    normalised_of_shape: Array
    squared: float  # mean squared error by the own covariance
    squared_by_bound: float
    readout: float  # in its own deviations


def _line(scene: _Scene, found: Sequence[_Errors]) -> str:
    def every(name: str) -> Array:
        return np.concatenate([np.ravel(getattr(error, name)) for error in found])

    middle = [
        np.median(every(name)) for name in ("places", "turns", "places_of_shape", "turns_of_shape")
    ]
    shares = [_inside(every(name), 3.0) for name in ("normalised", "normalised_of_shape")]
    readout = ", ".join(f"{value:.1f}" for value in every("readout"))
    return (
        f"{scene.name:36} {len(every('places')):5} {middle[0]:8.2f} {middle[1]:7.3f} "
        f"{middle[2]:8.2f} {middle[3]:8.3f} {shares[0]:12.1f} {shares[1]:6.1f} "
        f"{np.sqrt(np.mean(every('squared'))):15.2f}    {readout:>18}"
    )


def _one(scene: _Scene, seeds: list[int], lighting: Lighting | None, known: bool = True) -> _Errors:
    rng = np.random.default_rng(seeds)
    walk = a_walk(rng, 0.0, 0.15) if scene.walls else a_walk(rng, 0.6, scene.wide)
    poses = grid(3, 2, 0.06, 0.02) if scene.walls else ring(rng, 12)
    size = 0.06 if scene.walls else 0.15
    film = Film(scene.camera, walk, np.arange(0.0, scene.seconds, 1.0 / scene.rate))
    spotted: list[Spotted]
    if lighting is None:
        spotted = film.spot(poses, size, _NOISE, rng)
    else:
        spotted = rendered_spots(film, poses, size, FAMILY, lighting)
    markers = every_marker([family(FAMILY)], size, {})
    camera = estimators_camera(scene.camera, scene.camera.readout_time if known else 0.0)
    return _errors(survey(camera, spotted, markers), poses, size)


def _errors(found: Survey, poses: list[tuple[Array, Array]], size: float) -> _Errors:
    """In the frame of the first marker, and of the shape: all corners laid over the truth."""
    turn, origin = poses[found.markers[0].id]
    true = [(turn.T @ poses[m.id][0], turn.T @ (poses[m.id][1] - origin)) for m in found.markers]
    off = _off(found, true, np.eye(3), np.zeros(3))
    squares = np.concatenate([size * SQUARE @ axes.T + place for axes, place in true])
    ours = np.concatenate([marker.corners for marker in found.markers])
    back = Rotation.align_vectors(squares - squares.mean(axis=0), ours - ours.mean(axis=0))[0]
    over = back.as_matrix()
    shape = _off(found, true, over, squares.mean(axis=0) - over @ ours.mean(axis=0))
    own, free = off[1:].ravel(), found.covariance[6:, 6:]
    squared = float(own @ np.linalg.solve(free, own)) / len(own)
    asked = found.cameras[0].readout_check
    return _Errors(
        *_sizes(off[1:]),
        *_sizes(shape),
        off[1:] / found.deviations[1:],
        shape / found.deviations_of_shape,
        squared,
        squared * _by_bound(found.fit),
        np.nan if asked is None else (asked.estimated - asked.given) / asked.deviation,
    )


def _by_bound(found: Fit) -> float:
    """The survey's covariance by that of the bound: the inverse of the normal matrix at the true
    noise, all weights one.
    """
    squared, limit = found.squared_errors[found.inliers], (LIMIT * found.deviation) ** 2
    weight = float(np.mean((1.0 - squared / limit) ** 2))
    return found.inflation * found.deviation**2 / (weight * _NOISE**2)


def _off(found: Survey, true: list[tuple[Array, Array]], turn: Array, shift: Array) -> Array:
    """Errors (m,6) of places and turns after a motion of the whole."""
    return np.array([
        np.concatenate([
            turn @ marker.pose.position + shift - place,
            Rotation.from_matrix(turn @ marker.pose.rotation @ axes.T).as_rotvec(),
        ])
        for marker, (axes, place) in zip(found.markers, true, strict=True)
    ])  # fmt: skip


def _sizes(off: Array) -> tuple[Array, Array]:
    """Of errors (m,6): mm and deg."""
    return (
        1e3 * np.linalg.norm(off[:, :3], axis=1),
        np.degrees(np.linalg.norm(off[:, 3:], axis=1)),
    )
