# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The sequences on which solvers are compared within RANSAC: a recording and simulated flights."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.data import HAND_MOTION, WEBCAM
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.clouds import read_correspondences
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC
from rs_localizer.io.trajectories import read_tum
from rs_localizer.settings import load_params_file
from rs_localizer.tools.simulation.frames import frame_stamps, simulate_frames
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion, sampled_states

_POINTS = 150
_OUTLIERS = 0.3
_READOUT_TIME = 0.03
_HARD_TURN, _HARD_WAY = 30.0, 0.3  # deg and m per readout
_DEPTH = (1.0, 4.0)  # m


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """What a robust loop gets of one frame."""

    points: Array  # (n,3)
    pixels: Array  # (n,2) raw


@dataclass(frozen=True, slots=True)
class Sequence:
    """Frames of one camera, and the threshold at which inliers are counted."""

    name: str
    title: str
    camera: Camera
    frames: tuple[Frame, ...]
    threshold: float  # px


def sequences(frames: int, seed: int) -> list[Sequence]:
    """All of them, with so many frames each."""
    phone, action = _camera(1280, 720, 1000.0), _camera(1920, 1080, 900.0)
    # No hand keeps the fastest motion of the paper up: every frame is of a motion by itself.
    hard = [_single(action, np.random.default_rng([seed, k]), noise=2.0) for k in range(frames)]
    recorded, bundled = _webcam(frames)
    return [
        Sequence(
            "phone", "phone, 1280x720, 2 px (simulated along a hand's motion)", phone,
            _fly(phone, frames, seed, noise=0.5, speed=1.0), 2.0,
        ),
        Sequence(
            "action_camera", "action camera, 1920x1080, 8 px (simulated, three times as fast)",
            action, _fly(action, frames, seed, noise=2.0, speed=3.0), 8.0,
        ),
        Sequence(
            "hard", f"{_HARD_TURN:g} degrees and {_HARD_WAY:g} m per readout, 8 px (simulated)",
            action, tuple(hard), 8.0,
        ),
        Sequence(
            "webcam", "webcam over a chessboard, 640x480, 2 px (recorded)", bundled, recorded, 2.0
        ),
    ]  # fmt: skip


def _webcam(frames: int) -> tuple[tuple[Frame, ...], Camera]:
    """The bundled recording: a plane, and few points."""
    found: list[Frame] = []
    readout_time = load_params_file(WEBCAM / "parameters.yaml")["readout_time"]
    with open_bag(WEBCAM) as bag:
        for topic, _, message in bag.messages([CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC]):
            if topic == CAMERA_INFO_TOPIC:
                info = read_camera_info(message)
            else:
                cloud = read_correspondences(message)
                found.append(Frame(cloud.points, cloud.pixels))
    chosen = tuple(found[i] for i in _evenly(len(found), frames))
    return chosen, info.camera(readout_time, ScanDirection.TOP_TO_BOTTOM)


def _camera(width: int, height: int, focal: float) -> Camera:
    K = np.array(
        [[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]
    )
    return Camera(width=width, height=height, K=K, readout_time=_READOUT_TIME)


def _fly(camera: Camera, frames: int, seed: int, noise: float, speed: float) -> tuple[Frame, ...]:
    poses = read_tum(HAND_MOTION)
    motion = RecordedMotion(
        replace(poses, stamps_ns=(poses.stamps_ns / speed).astype(np.int64)),
        knot_spacing=0.05 / speed,
    )
    stamps = frame_stamps(motion, camera, rate=30.0)
    simulated = simulate_frames(
        camera,
        motion,
        room(sampled_states(motion).positions, np.random.default_rng(seed)),
        FrameSettings(points=_POINTS, noise=noise, outliers=_OUTLIERS),
        stamps_ns=[stamps[i] for i in _evenly(len(stamps), frames)],
        seed=seed,
    )
    return tuple(Frame(frame.points, frame.pixels) for frame in simulated)


def _single(camera: Camera, rng: np.random.Generator, noise: float) -> Frame:
    def direction() -> Array:
        vector = rng.normal(size=3)
        unit: Array = vector / np.linalg.norm(vector)
        return unit

    def anywhere(count: int) -> Array:
        return rng.uniform(-0.5, np.array(camera.size) - 0.5, (count, 2))

    motion = Motion(
        so3.exp(rng.uniform(0.0, np.pi) * direction()),
        rng.normal(size=3),
        np.radians(_HARD_TURN) * direction(),
        _HARD_WAY * direction(),
    )
    pixels = anywhere(_POINTS)
    # Each point is seen at the time of its row.
    turns, moves = motion.at_rows(camera.row_time(pixels))
    rays = np.column_stack([camera.rays(pixels), np.ones(_POINTS)])
    local = rng.uniform(*_DEPTH, (_POINTS, 1)) * rays
    points = np.einsum("nji,nj->ni", turns, local - moves)
    pixels += noise * rng.normal(size=pixels.shape)
    wrong = round(_OUTLIERS * _POINTS)
    pixels[:wrong] = anywhere(wrong)
    return Frame(points, pixels)


def _evenly(count: int, wanted: int) -> list[int]:
    """So many indices below ``count``, spread evenly."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(int))]
