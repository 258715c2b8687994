# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of a room and of markers by the projector of the tests."""

from dataclasses import dataclass, replace

import numpy as np
import projector
from scipy.spatial.transform import Rotation

from benchmarks.mapping import Film
from rs_localizer.core.camera import Camera
from rs_localizer.tools.mapping.map_keypoints import MapObservations, Start
from rs_localizer.tools.mapping.unknown_markers import Spotted

READOUT = 0.03
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def camera(readout: float = READOUT) -> Camera:
    return projector.make_camera(readout_time=readout)


def hand(rng: np.random.Generator, slow: float = 0.5) -> projector.Motion:
    """A hand that also moves half a metre to and fro."""
    motion = projector.Motion.random(rng)
    amplitudes, frequencies = motion.amplitudes.copy(), motion.frequencies.copy()
    amplitudes[3:, :2] = slow
    frequencies[3:, :2] = 2.0 * np.pi * rng.uniform(0.1, 0.4, (3, 2))
    return projector.Motion(amplitudes, frequencies, motion.phases)


@dataclass(frozen=True)
class Walk:
    """What is refined, and the truth."""

    seen: MapObservations
    start: Start
    points: np.ndarray  # (p,3)


def film(motion: projector.Motion, stamps: np.ndarray, readout: float = READOUT) -> Film:
    return Film(replace(projector.TRUE, readout_time=readout), motion, stamps)


def walk(
    rng: np.random.Generator, stamps: np.ndarray, *, points: int = 150, count: int = 60,
    readout: float = READOUT,
) -> Walk:  # fmt: skip
    """A map that is 2 cm off, seen at stamps (g,), s."""
    shown, room = film(hand(rng), stamps, readout), projector.room(rng, points)
    return Walk(shown.see(room, rng, count), shown.near(room, rng), room)


def ring(rng: np.random.Generator, count: int, size: float) -> list[tuple[np.ndarray, np.ndarray]]:
    """Poses (3,3), (3,) map_from_marker of markers before the camera, tilted at random."""
    poses = []
    for k in range(count):
        angle = (k - 0.5 * (count - 1)) * 0.28
        place = np.array([2.0 * np.sin(angle), rng.uniform(-0.3, 0.3), 2.0 * np.cos(angle)])
        facing = np.diag([1.0, -1.0, -1.0])  # y up is -y of a camera, z toward it
        turn = Rotation.from_euler("y", angle).as_matrix() @ facing
        tilt = Rotation.from_rotvec(rng.normal(0.0, 0.25, 3)).as_matrix()
        poses.append((turn @ tilt, place))
    return poses


def spot(
    rng: np.random.Generator, poses: list[tuple[np.ndarray, np.ndarray]], size: float,
    stamps: np.ndarray,
) -> list[Spotted]:  # fmt: skip
    """The markers that images at stamps (g,), s, of their first rows show as a whole."""
    return film(hand(rng, 0.25), stamps, READOUT).spot(poses, size, rng)
