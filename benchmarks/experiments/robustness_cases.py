# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the Localizer is tried on: cases, and frames drawn for them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from benchmarks.experiments.views import View, direction, seen_at, uniform_pixels
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion

_SIZE = 1000
_NOISE = 1.0  # px
_DEPTH = (1.0, 4.0)  # m
# A second object has turned and moved by so much against the scene (deg, m).
_OBJECT = (20.0, 0.5)
_PERIOD = 0.3  # m from one window of a facade to the next


@dataclass(frozen=True, slots=True)
class Case:
    """Frames of one kind."""

    name: str
    label: str
    points: int = 200
    uniform: float = 0.0  # share of pixels anywhere in the image
    second: float = 0.0  # share of points on an object that moves by itself
    shifted: float = 0.0  # share of points matched one period aside
    field_of_view: float = 45.0  # deg
    offset: float = 0.0  # m, of the map's origin
    scores: str = ""  # "right", "random" or "reversed"
    motion: float = 1.0  # of 10 deg and 0.1 m per readout
    at_least: float = 0.99  # share localized correctly; NaN: no claim
    frames: float = 0.2  # per trial


HARD = Case("uniform_70", "70 % uniform outliers", uniform=0.7, frames=0.5)
CASES = (
    HARD,
    Case("uniform_50", "50 % uniform outliers", uniform=0.5),
    Case("object", "30 % on a second moving object", second=0.3),
    Case("object_uniform", "30 % on an object, 20 % uniform", second=0.3, uniform=0.2),
    Case("texture", "30 % shifted by a period", shifted=0.3),
    Case("points_12", "12 points", points=12, at_least=math.nan),
    Case("points_20", "20 points", points=20),
    Case("points_50", "50 points, 30 % uniform", points=50, uniform=0.3),
    Case("points_1000", "1000 points, 50 % uniform", points=1000, uniform=0.5),
    Case("points_5000", "5000 points, 50 % uniform", points=5000, uniform=0.5, frames=0.05),
    Case("narrow", "field of view 10 deg, 30 % uniform, 2 deg", field_of_view=10.0, uniform=0.3,
         motion=0.2),
    Case("narrow_fast", "field of view 10 deg, 30 % uniform, 10 deg", field_of_view=10.0,
         uniform=0.3, at_least=math.nan),
    Case("wide", "field of view 120 deg, 30 % uniform", field_of_view=120.0, uniform=0.3),
    Case("offset", "origin 5e6 m away, 30 % uniform", offset=5e6, uniform=0.3),
    Case("scores_right", "right scores, 50 % uniform", scores="right", uniform=0.5),
    Case("scores_random", "random scores, 50 % uniform", scores="random", uniform=0.5),
    Case("scores_reversed", "reversed scores, 50 % uniform", scores="reversed", uniform=0.5),
)  # fmt: skip


def camera_of(field_of_view: float) -> Camera:
    focal = 0.5 * _SIZE / math.tan(0.5 * math.radians(field_of_view))
    centre = 0.5 * (_SIZE - 1)
    K = np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    return Camera(width=_SIZE, height=_SIZE, K=K)


def view_of(case: Case, view: Camera, rng: np.random.Generator) -> View:
    """A frame: pixels are drawn first, and their points lie on the rays of their rows."""
    n = case.points
    pixels = uniform_pixels(view, n, rng)
    place = case.offset * direction(rng)
    motion = _motion(so3.exp(math.pi * rng.uniform(-1.0, 1.0, 3)), place + rng.normal(size=3), case,
                     rng)  # fmt: skip
    points = seen_at(motion, view, pixels, rng.uniform(*_DEPTH, n))
    group = np.zeros(n, dtype=np.int64)  # 0: the scene
    order, first = rng.permutation(n), 0
    for kind, part in enumerate((case.uniform, case.second, case.shifted), 1):
        group[order[first : first + round(part * n)]] = kind
        first += round(part * n)
    measured = pixels + _NOISE * rng.normal(size=(n, 2))
    measured[group == 1] = uniform_pixels(view, int(np.count_nonzero(group == 1)), rng)
    # The camera as the object sees it: elsewhere, and moving in another way.
    other = group == 2
    turn, way = _OBJECT
    beside = _motion(
        so3.exp(math.radians(turn) * direction(rng)) @ motion.rotation,
        -motion.rotation.T @ motion.translation + way * direction(rng),
        case,
        rng,
    )
    points[other] = seen_at(beside, view, pixels[other], rng.uniform(*_DEPTH, n)[other])
    points[group == 3] += _PERIOD * motion.rotation[0]  # along the rows of the image
    return View(view, points, measured, pixels, group == 0, motion, _NOISE)


def _motion(rotation: Array, position: Array, case: Case, rng: np.random.Generator) -> Motion:
    turn, travel = math.radians(10.0) * case.motion, 0.1 * case.motion
    return Motion(rotation, -rotation @ position, turn * direction(rng), travel * direction(rng))


def scores_of(case: Case, inliers: BoolArray, rng: np.random.Generator) -> Array | None:
    if not case.scores:
        return None
    noise = rng.normal(size=len(inliers))
    gain = {"right": 2.0, "random": 0.0, "reversed": -2.0}[case.scores]
    scores: Array = noise + gain * inliers
    return scores
