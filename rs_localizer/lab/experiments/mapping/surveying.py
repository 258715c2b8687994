"""Markers surveyed: a printed wall, and twelve around a room."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.lab.experiments.mapping.rooms import (
    Film,
    Walk,
    a_walk,
    estimators_camera,
    grid,
    ring,
)
from rs_localizer.lab.independent.cameras import Camera
from rs_localizer.mapping.gauge import similarity
from rs_localizer.mapping.spotting import every_marker
from rs_localizer.mapping.survey import Survey, survey
from rs_localizer.markers.families import family

_NOISE = 0.1  # px
_LARGE = Camera(width=1280, height=960, focal=840.0)


def surveys(seed: int, trials: int = 3) -> Iterator[str]:
    """Errors of the markers in the frame of the first, and what they are told to be."""
    yield "scene                              markers     mm      deg  laid over (mm)   in 3 (%)"
    room = 0.6, 0.5
    for name, camera, walls in (
        ("printed wall 3x2 of 0.06 m, VGA", Camera(), True),
        ("12 of 0.15 m around a room, VGA", Camera(), False),
        ("12 of 0.15 m around a room, 1280x960", _LARGE, False),
    ):
        found = []
        for trial in range(trials):
            rng = np.random.default_rng([seed, trial])
            walk = a_walk(rng, 0.0, 0.15) if walls else a_walk(rng, *room)
            poses = grid(3, 2, 0.06, 0.02) if walls else ring(rng, 12)
            found.append(_one(rng, camera, walk, poses, 0.06 if walls else 0.15))
        places, turns, over, shares = (np.concatenate(parts) for parts in zip(*found, strict=True))
        yield (
            f"{name:36} {len(places):5} {np.median(places):8.2f} {np.median(turns):8.3f} "
            f"{np.median(over):12.2f} {100 * np.mean(shares):15.1f}"
        )


def _one(
    rng: np.random.Generator, camera: Camera, walk: Walk, poses: list[tuple[Array, Array]],
    size: float,
) -> tuple[Array, Array, Array, Array]:  # fmt: skip
    stamps = np.arange(0.0, 30.0, 1.0 / 30.0)
    spotted = Film(camera, walk, stamps).spot(poses, size, _NOISE, rng)
    markers = every_marker([family("4x4_50")], size, {})
    return _errors(survey(estimators_camera(camera, camera.readout_time), spotted, markers), poses)


def _errors(found: Survey, poses: list[tuple[Array, Array]]) -> tuple[Array, Array, Array, Array]:
    """Place (mm) and turn (deg) in the frame of the first marker; place when all are laid over
    the truth; and which coordinates lie within three deviations.
    """
    turn, origin = poses[found.markers[0].id]
    ours = np.array([marker.pose.position for marker in found.markers])
    true = np.array([turn.T @ (poses[marker.id][1] - origin) for marker in found.markers])
    turns = [
        Rotation.from_matrix(m.pose.rotation @ (turn.T @ poses[m.id][0]).T).magnitude()
        for m in found.markers
    ]
    whole = similarity(ours, true)
    whole = type(whole)(1.0, whole.rotation, true.mean(0) - whole.rotation @ ours.mean(0))
    within = np.abs(ours - true)[1:] < 3.0 * found.deviations[1:, :3]
    return (
        1e3 * np.linalg.norm(ours - true, axis=1)[1:],
        np.degrees(turns)[1:],
        1e3 * np.linalg.norm(whole(ours) - true, axis=1),
        within.mean(axis=1),
    )
