# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording of two cameras with opposed scans before a wall."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer import data
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.rigs import RigParts, node_parameters
from rs_localizer.io.trajectories import read_tum
from rs_localizer.settings import write_parameters
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import FrameSettings, simulate_frames
from rs_localizer.tools.simulation.simulated_recording import (
    RIG_FRAME,
    RigFrame,
    camera_stamps,
    make_mounts,
    simulate_rig,
    write_rig_frame,
)
from rs_localizer.tools.simulation.true_motion import ConstantVelocity, RecordedMotion, TrueMotion

K = np.array([[450.0, 0.0, 319.5], [0.0, 450.0, 239.5], [0.0, 0.0, 1.0]])
# The second camera hangs upside down, 10 cm to the right of the first.
UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0])
PARTS = RigParts(
    {name: Camera(640, 480, K, readout_time=0.03) for name in ("left", "right")},
    {"left": (np.eye(3), np.zeros(3)), "right": (UPSIDE_DOWN, -UPSIDE_DOWN @ [0.1, 0.0, 0.0])},
    {"left": 0.0, "right": 0.004},
)
ANGULAR, LINEAR = np.array([0.3, -0.5, 0.2]), np.array([0.2, -0.3, 0.1])


def wall(count: int = 6000) -> np.ndarray:
    """Points (n,3) of a tilted plane about 2.5 m ahead; the rig looks along x, z is up."""
    y, z = np.random.default_rng(7).uniform(-4.0, 4.0, (2, count))
    return np.column_stack([2.5 + 0.2 * y - 0.15 * z, y, z])


def hand(begin: float, seconds: float) -> TrueMotion:
    """Some seconds of the bundled motion of a hand-held rig."""
    motion = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    start_ns = motion.intervals_ns[0][0] + round(begin * 1e9)
    return Part(motion, [(start_ns, start_ns + round(seconds * 1e9))])


@dataclass(frozen=True)
class Part:
    motion: TrueMotion
    intervals_ns: list[tuple[int, int]]

    def state(self, stamp_ns: int, offsets: Any) -> Any:
        return self.motion.state(stamp_ns, offsets)


def rich(motion: TrueMotion) -> np.ndarray:
    """Points (n,3) of a room all around a motion."""
    start_ns, end_ns = motion.intervals_ns[0]
    places = motion.state(start_ns, np.linspace(0.0, 1e-9 * (end_ns - start_ns), 50)).positions
    return room(places, np.random.default_rng(3))


def record(
    path: Path,
    seconds: float = 1.0,
    keep: Callable[[RigFrame], bool] = lambda image: True,
    motion: TrueMotion | None = None,
    points: np.ndarray | None = None,
    true: RigParts = PARTS,
) -> TrueMotion:
    """Write a recording with its parameters; the true motion of the rig.

    ``true``: the rig as it is, where it differs from what the recording says.
    """
    motion = motion or ConstantVelocity(ANGULAR, LINEAR, seconds, start_ns=1_000_000_000)
    settings = FrameSettings(points=80, noise=0.5, outliers=0.2)
    stamps = camera_stamps(PARTS, motion, settings.rate, seed=4)
    points = wall() if points is None else points

    def see(name: str, mounted: TrueMotion, seed: int) -> Any:
        camera = true.cameras[name]
        return simulate_frames(
            camera, mounted, points, settings, stamps_ns=stamps[name], seed=1 + seed
        )

    with BagWriter(path) as bag:
        bag.write("/tf_static", make_mounts(PARTS), motion.intervals_ns[0][0] - 100_000_000)
        for image in simulate_rig(true, motion, see):
            if keep(image):
                write_rig_frame(bag, PARTS, motion, image)
    write_parameters(path / "parameters.yaml", {**node_parameters(PARTS), "base_frame": RIG_FRAME})
    return motion
