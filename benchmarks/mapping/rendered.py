# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Corners of markers as the detector finds them in rendered images of a walk."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.mapping.rooms import Carried, Film, Walk, estimators_camera
from rs_localizer.core.arrays import Array
from rs_localizer.mapping.unknown_markers import Spotted, Spotter, every_marker
from rs_localizer.markers.dictionaries import pattern
from rs_localizer.markers.families import Family, family
from rs_localizer.simulation.planes import TexturedPlane
from rs_localizer.simulation.renderer import Renderer
from rs_localizer.simulation.settings import ImageSettings
from rs_localizer.simulation.true_motion import TrueState

_CELL_TEXELS = 24
_PAPER, _INK = 235, 26
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
    cells = np.where(white, _PAPER, _INK).astype(np.uint8)
    texture = cells.repeat(_CELL_TEXELS, axis=0).repeat(_CELL_TEXELS, axis=1)
    texel = size / (of.cells * _CELL_TEXELS)
    half = 0.5 * texel * len(texture)
    corner = place - half * axes[:, 0] + half * axes[:, 1]
    return TexturedPlane(corner, axes[:, 0], -axes[:, 1], texel, texture)
