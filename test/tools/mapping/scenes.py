# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of a room and of markers by the projector of the tests."""

from dataclasses import dataclass

import numpy as np
import projector
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
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


def walk(
    rng: np.random.Generator, stamps: np.ndarray, *, points: int = 150, count: int = 60,
    noise: float = 0.3, off: float = 0.02, readout: float = READOUT,
) -> Walk:  # fmt: skip
    """A map that is ``off`` (m), seen at stamps (g,), s."""
    motion, room = hand(rng), projector.room(rng, points)
    images, landmarks, pixels = [], [], []
    for g, stamp in enumerate(stamps):
        exposed = projector.expose(motion, float(stamp), readout, room)
        shown = rng.permutation(np.flatnonzero(np.isfinite(exposed[:, 0])))[:count]
        images.append(np.full(len(shown), g))
        landmarks.append(shown)
        pixels.append(exposed[shown] + rng.normal(0.0, noise, (len(shown), 2)))
    rotations, positions = motion.pose(stamps + 0.5 * readout)
    start = Start(
        room + rng.normal(0.0, off, room.shape),
        rotations @ so3.exp_many(rng.normal(0.0, 0.2 * off, (len(stamps), 3))),
        positions + rng.normal(0.0, off, positions.shape),
    )
    stamps_ns = 10**12 + np.round(1e9 * stamps).astype(np.int64)
    seen = MapObservations(
        stamps_ns, np.concatenate(images), np.concatenate(landmarks), np.concatenate(pixels)
    )
    return Walk(seen, start, room)


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
    stamps: np.ndarray, noise: float = 0.1,
) -> list[Spotted]:  # fmt: skip
    """The markers that images at stamps (g,), s, of their first rows show as a whole."""
    motion = hand(rng, 0.25)
    corners = np.concatenate([size * SQUARE @ turn.T + place for turn, place in poses])
    spotted = []
    for stamp in stamps:
        quads = projector.expose(motion, float(stamp), READOUT, corners).reshape(-1, 4, 2)
        whole = np.flatnonzero(np.isfinite(quads).all(axis=(1, 2)))
        found = quads[whole] + rng.normal(0.0, noise, (len(whole), 4, 2))
        spotted.append(Spotted(10**12 + round(1e9 * float(stamp)), whole, found))
    return spotted
