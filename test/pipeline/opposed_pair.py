# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A recording of two cameras with opposed scans before a wall."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.rigs import RigParts
from rs_localizer.settings import write_parameters
from rs_localizer.simulation.rig import (
    RigFrame,
    camera_stamps,
    rig_parameters,
    simulate_rig,
    write_mounts,
    write_rig_frame,
)
from rs_localizer.simulation.settings import FrameSettings
from rs_localizer.simulation.true_motion import ConstantVelocity

K = np.array([[450.0, 0.0, 319.5], [0.0, 450.0, 239.5], [0.0, 0.0, 1.0]])
# The second camera hangs upside down, 10 cm to the right of the first.
UPSIDE_DOWN = np.diag([-1.0, -1.0, 1.0])
PARTS = RigParts(
    {name: Camera(640, 480, K, readout_time=0.03) for name in ("left", "right")},
    {
        "left": (np.eye(3), np.zeros(3)),
        "right": (UPSIDE_DOWN, -UPSIDE_DOWN @ [0.1, 0.0, 0.0]),
    },
    {"left": 0.0, "right": 0.004},
)
ANGULAR, LINEAR = np.array([0.3, -0.5, 0.2]), np.array([0.2, -0.3, 0.1])


def wall(count: int = 6000) -> np.ndarray:
    """Points (n,3) of a tilted plane about 2.5 m ahead; the rig looks along x, z is up."""
    y, z = np.random.default_rng(7).uniform(-4.0, 4.0, (2, count))
    return np.column_stack([2.5 + 0.2 * y - 0.15 * z, y, z])


def record(
    path: Path,
    seconds: float = 1.0,
    noise: float = 0.5,
    keep: Callable[[RigFrame], bool] = lambda image: True,
    names: tuple[str, ...] = ("left", "right"),
    **parameters: Any,
) -> ConstantVelocity:
    """Write a recording with its parameters; the true motion of the rig."""
    motion = ConstantVelocity(ANGULAR, LINEAR, seconds, start_ns=1_000_000_000)
    settings = FrameSettings(points=80, noise=noise, outliers=0.2)
    parts = PARTS._replace(cameras={name: PARTS.cameras[name] for name in names})
    stamps = camera_stamps(parts, motion, settings.rate, seed=4, triggered=False)
    with BagWriter(path) as bag:
        write_mounts(bag, parts, 900_000_000)
        for image in simulate_rig(parts, motion, wall(), settings, stamps_ns=stamps, seed=1):
            if keep(image):
                write_rig_frame(bag, parts, motion, image)
    write_parameters(path / "parameters.yaml", rig_parameters(parts) | parameters)
    return motion
