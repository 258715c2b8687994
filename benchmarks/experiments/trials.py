# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The paper's synthetic set-up: frames of a moving rolling-shutter camera, many at once.

Points are uniform in [-1, 1]^3, the camera stands at a distance of 2 to 3 from their centre and
looks at it, with a field of view of 45 degrees; it turns at a constant rate, about an axis of any
direction, and moves at a constant velocity of any direction during the readout. Rotations are
exact. A frame lasts one readout.
"""

import math
from dataclasses import dataclass
from functools import lru_cache
from operator import attrgetter

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import project_rolling

# So many points per frame are drawn; minimal solvers take the first ones of them.
POINTS = 50
_DISTANCE = (2.0, 3.0)
_FIELD_OF_VIEW = math.radians(45.0)
_SIZE = 1000  # pixels of the image's side
# Under the fastest motion seven points in ten lie in the image.
_CANDIDATES_PER_POINT = 2
# Frames that are drawn together: their points fit the processor's cache.
_AT_ONCE = 50


def camera() -> Camera:
    """The camera of the synthetic experiments."""
    focal = 0.5 * _SIZE / math.tan(0.5 * _FIELD_OF_VIEW)
    centre = 0.5 * (_SIZE - 1)
    K = np.array([[focal, 0.0, centre], [0.0, focal, centre], [0.0, 0.0, 1.0]])
    return Camera(width=_SIZE, height=_SIZE, K=K)


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """h poses with velocities in the solvers' own parameters (model A), per readout."""

    rotation: Array  # (h,3,3) camera_from_world at the middle row
    translation: Array  # (h,3)
    w: Array  # (h,3) rad: the scene turns about the camera
    t: Array  # (h,3): and drifts

    def __len__(self) -> int:
        return len(self.rotation)

    @property
    def position(self) -> Array:
        """Camera centres (h,3) in the world."""
        return np.asarray(-np.einsum("hji,hj->hi", self.rotation, self.translation))


@dataclass(frozen=True, slots=True, eq=False)
class Trials:
    """h frames of n points each, and the motions behind them."""

    points: Array  # (h,n,3)
    rays: Array  # (h,n,2)
    tau: Array  # (h,n)
    truth: Motions

    def __len__(self) -> int:
        return len(self.points)


@dataclass(frozen=True, slots=True)
class Setting:
    """What a sweep varies."""

    angular: float = 0.0  # deg per frame
    linear: float = 0.0  # units of the scene per frame
    noise: float = 0.0  # px, standard deviation of u and of v
    # The velocity is that of the camera's centre, straight through the world (model B). Drifting
    # instead, the scene moves straight past the turning camera (model A): the camera swings about
    # the scene.
    drifting: bool = False


# Half of the points that leave the image are seen by no row, which takes the search for their row
# its longest; several experiments use the same frames.
@lru_cache(maxsize=64)
def draw_trials(count: int, seed: int, setting: Setting) -> Trials:
    """Frames of random cameras, kept for the next caller: not to be written to."""
    rng = np.random.default_rng(seed)
    parts: list[Trials] = []
    while (left := count - sum(map(len, parts))) > 0:
        parts.append(_draw(min(left, _AT_ONCE), rng, setting))
    return _join(parts)


def random_rotations(count: int, seed: int, degrees: float) -> Array:
    """Rotations (count,3,3) by an angle about axes of any direction."""
    rng = np.random.default_rng([seed, 1])
    return so3.exp_many(math.radians(degrees) * _directions(count, rng))


def angles(rotations: Array, others: Array) -> Array:
    """Angles in degrees between rotations (...,3,3); accurate near zero, NaN for NaN."""
    apart = np.linalg.norm(rotations - others, axis=(-2, -1))
    return np.asarray(np.degrees(2.0 * np.arcsin(np.minimum(apart / np.sqrt(8.0), 1.0))))


def _draw(count: int, rng: np.random.Generator, setting: Setting) -> Trials:
    """Up to ``count`` frames: those that see enough points."""
    view = camera()
    candidates = _CANDIDATES_PER_POINT * POINTS
    rotation, translation = _looking_at_the_centre(count, rng)
    w = math.radians(setting.angular) * _directions(count, rng)
    velocity = setting.linear * _directions(count, rng)
    t = velocity if setting.drifting else np.cross(w, translation) - velocity
    points = rng.uniform(-1.0, 1.0, (count, candidates, 3))
    owner = np.repeat(np.arange(count), candidates)

    def poses_at(tau: Array) -> tuple[Array, Array]:
        turns = so3.exp_many(tau[:, None] * w[owner])
        if setting.drifting:
            return turns @ rotation[owner], translation[owner] + tau[:, None] * t[owner]
        moved = translation[owner] - tau[:, None] * velocity[owner]
        return turns @ rotation[owner], np.einsum("nij,nj->ni", turns, moved)

    pixels, _ = project_rolling(view, poses_at, points.reshape(-1, 3))
    inside = view.inside(pixels).reshape(count, candidates)
    kept = np.flatnonzero(inside.sum(axis=1) >= POINTS)
    seen = np.argsort(~inside, axis=1, kind="stable")[kept, :POINTS]
    noise = setting.noise * rng.normal(size=(count, POINTS, 2))[kept]
    pixels = (pixels.reshape(count, candidates, 2)[kept[:, None], seen] + noise).reshape(-1, 2)
    return Trials(
        points[kept[:, None], seen],
        view.rays(pixels).reshape(-1, POINTS, 2),
        view.row_time(pixels).reshape(-1, POINTS),
        Motions(rotation[kept], translation[kept], w[kept], t[kept]),
    )


def _looking_at_the_centre(count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    position = _directions(count, rng) * rng.uniform(*_DISTANCE, (count, 1))
    z = -position / np.linalg.norm(position, axis=1, keepdims=True)
    x = np.cross(_directions(count, rng), z)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    rotation = np.stack([x, np.cross(z, x), z], axis=1)
    return rotation, -np.einsum("hij,hj->hi", rotation, position)


def _directions(count: int, rng: np.random.Generator) -> Array:
    vectors = rng.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))


def _join(parts: list[Trials]) -> Trials:
    def joined(*names: str) -> list[Array]:
        return [np.concatenate([attrgetter(name)(part) for part in parts]) for name in names]

    points, rays, tau = joined("points", "rays", "tau")
    truth = joined("truth.rotation", "truth.translation", "truth.w", "truth.t")
    return Trials(points, rays, tau, Motions(*truth))
