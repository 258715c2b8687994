# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings of a room and of markers by the tests' own rolling-shutter camera."""

from dataclasses import dataclass, replace

import numpy as np
import projector
from scipy.spatial.transform import Rotation

from rs_localizer.core import so3
from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.variables import Extrinsics, Mounting
from rs_localizer.tools.mapping.observations import Adjusted, MapObservations, Start
from rs_localizer.tools.mapping.unknown_markers import Spotted

READOUT = 0.03
SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


def camera(readout: float = READOUT) -> Camera:
    return Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, D=projector.D,
                  readout_time=readout)  # fmt: skip


# A second camera looks back, 10 cm beside the first; its shutter runs up.
UP = replace(camera(), scan_direction="bottom_to_top")
BACK = Rotation.from_euler("yx", [175.0, 10.0], degrees=True).as_matrix()
CENTRE = np.array([0.1, -0.02, -0.05])
# What its extrinsics and its clock are known to, and how far off they are given.
DEVIATIONS = np.repeat([1.7e-3, 5e-3, 1.5e-3], [3, 3, 1])
OFF = DEVIATIONS * [1.0, -1.0, 0.5, 1.0, 1.0, -1.0, 1.0]
MOUNTED = Mounting(Extrinsics(BACK, CENTRE, 0.0).moved(OFF), DEVIATIONS)


def is_mounted_back(found: Adjusted) -> None:
    """And the recording knows turns and the clock better than they were given."""
    errors = found.extrinsics.beside(Extrinsics(BACK, CENTRE, 0.0))
    assert np.all(np.abs(errors) < 4.0 * found.deviations)
    assert np.all(found.deviations[[0, 1, 2, 6]] < 0.7 * DEVIATIONS[[0, 1, 2, 6]])
    assert not found.readout_check.differs


def hand(rng: np.random.Generator, slow: float = 0.5, stamps: int = 2) -> projector.Motion:
    """A hand that also moves half a metre to and fro."""
    motion = projector.Motion.random(rng)
    amplitudes, frequencies = motion.amplitudes.copy(), motion.frequencies.copy()
    amplitudes[3:, :stamps] = slow
    frequencies[3:, :stamps] = 2.0 * np.pi * rng.uniform(0.1, 0.4, (3, stamps))
    return projector.Motion(amplitudes, frequencies, motion.phases)


@dataclass(frozen=True)
class Flown:
    """Half a turn about the line of sight from one line to the next."""

    body: projector.Motion
    line: float  # s

    def pose(self, t):
        rotations, positions = self.body.pose(t)
        turns = np.outer(np.pi * (np.asarray(t) // self.line), [0.0, 0.0, 1.0])
        return rotations @ Rotation.from_rotvec(turns).as_matrix(), positions


@dataclass(frozen=True)
class Walk:
    """What is refined, and the truth."""

    seen: MapObservations
    start: Start
    points: np.ndarray  # (p,3)


def walk(
    rng: np.random.Generator, stamps: np.ndarray, *, points: int = 150, count: int = 60,
    noise: float = 0.3, off: float = 0.02, readout: float = READOUT, line: float = np.inf,
) -> Walk:  # fmt: skip
    """A map that is ``off`` (m), seen at stamps (g,), s; turned over after each ``line`` (s)."""
    motion, room = Flown(hand(rng), line), projector.room(rng, points)
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
    """The markers that images at stamps (g,), s, show as a whole."""
    return spot_along(rng, hand(rng, 0.25), poses, size, stamps, noise)


@dataclass(frozen=True)
class Carried:
    """A camera on a body that moves."""

    body: projector.Motion
    axes: np.ndarray  # (3,3) camera_from_body
    centre: np.ndarray  # (3,) m

    def pose(self, t):
        rotations, positions = self.body.pose(t)
        return rotations @ self.axes.T, positions + rotations @ self.centre


def spot_along(
    rng: np.random.Generator, motion: projector.Motion | Carried,
    poses: list[tuple[np.ndarray, np.ndarray]], size: float, stamps: np.ndarray,
    noise: float = 0.1, readout: float = READOUT,
) -> list[Spotted]:  # fmt: skip
    """The same, of a camera that moves so; the stamps are those of its first rows."""
    corners = np.concatenate([size * SQUARE @ turn.T + place for turn, place in poses])
    spotted = []
    for stamp in stamps:
        quads = projector.expose(motion, float(stamp), readout, corners).reshape(-1, 4, 2)
        whole = np.flatnonzero(np.isfinite(quads).all(axis=(1, 2)))
        found = quads[whole] + rng.normal(0.0, noise, (len(whole), 4, 2))
        spotted.append(Spotted(10**12 + round(1e9 * float(stamp)), whole, found))
    return spotted
