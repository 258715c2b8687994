# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The sequences on which solvers are compared within RANSAC: a recording and simulated flights."""

from __future__ import annotations

from collections.abc import Iterator
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
from rs_localizer.tools.simulation.true_motion import RecordedMotion

_POINTS = 150
_OUTLIERS = 0.3
_READOUT_TIME = 0.03
_WAY_SAMPLES = 400
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


def phone(frames: int, seed: int) -> Sequence:
    """A phone of 1280x720 in a hand: the recorded motion, simulated points, 2 px."""
    camera = _camera(1280, 720, focal=1000.0)
    return Sequence(
        "phone",
        "phone, 1280x720, 2 px (simulated along a hand's motion)",
        camera,
        tuple(_fly(camera, frames, seed, noise=0.5, speed=1.0)),
        2.0,
    )


def action_camera(frames: int, seed: int) -> Sequence:
    """A wide action camera of 1920x1080 at three times the speed, 8 px."""
    camera = _camera(1920, 1080, focal=900.0)
    return Sequence(
        "action_camera",
        "action camera, 1920x1080, 8 px (simulated, three times as fast)",
        camera,
        tuple(_fly(camera, frames, seed, noise=2.0, speed=3.0)),
        8.0,
    )


def hard(frames: int, seed: int) -> Sequence:
    """The action camera under the fastest motion of the paper's synthetic experiments, 8 px.

    No hand keeps that up: every frame is of a motion by itself, in any direction, past points at
    all depths from 1 to 4 m.
    """
    camera = _camera(1920, 1080, focal=900.0)
    return Sequence(
        "hard",
        f"{_HARD_TURN:g} degrees and {_HARD_WAY:g} m per readout, 1920x1080, 8 px (simulated)",
        camera,
        tuple(_single(camera, np.random.default_rng([seed, k]), noise=2.0) for k in range(frames)),
        8.0,
    )


def webcam(frames: int) -> Sequence:
    """The bundled webcam over a chessboard, 2 px: a plane, and few points."""
    found = list(_recorded())
    chosen = [found[i] for i in _evenly(len(found), frames)]
    return Sequence(
        "webcam",
        "webcam over a chessboard, 640x480, 2 px (recorded)",
        chosen[0][0],
        tuple(frame for _, frame in chosen),
        2.0,
    )


def _recorded() -> Iterator[tuple[Camera, Frame]]:
    camera = None
    readout_time = load_params_file(WEBCAM / "parameters.yaml")["readout_time"]
    with open_bag(WEBCAM) as bag:
        for topic, _, message in bag.messages([CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC]):
            if topic == CAMERA_INFO_TOPIC:
                camera = read_camera_info(message).camera(readout_time, ScanDirection.TOP_TO_BOTTOM)
            elif camera is not None:
                cloud = read_correspondences(message)
                yield camera, Frame(cloud.points, cloud.pixels)


def _camera(width: int, height: int, focal: float) -> Camera:
    K = np.array(
        [[focal, 0.0, 0.5 * (width - 1)], [0.0, focal, 0.5 * (height - 1)], [0.0, 0.0, 1.0]]
    )
    return Camera(width=width, height=height, K=K, readout_time=_READOUT_TIME)


def _fly(camera: Camera, frames: int, seed: int, noise: float, speed: float) -> Iterator[Frame]:
    poses = read_tum(HAND_MOTION)
    motion = RecordedMotion(
        replace(poses, stamps_ns=(poses.stamps_ns / speed).astype(np.int64)),
        knot_spacing=0.05 / speed,
    )
    way = np.concatenate(
        [
            motion.state(first, np.linspace(0.0, (last - first) * 1e-9, _WAY_SAMPLES)).positions
            for first, last in motion.intervals_ns
        ]
    )
    stamps = frame_stamps(motion, camera, rate=30.0)
    simulated = simulate_frames(
        camera,
        motion,
        room(way, np.random.default_rng(seed)),
        FrameSettings(points=_POINTS, noise=noise, outliers=_OUTLIERS),
        stamps_ns=[stamps[i] for i in _evenly(len(stamps), frames)],
        seed=seed,
    )
    for frame in simulated:
        yield Frame(frame.points, frame.pixels)


def _single(camera: Camera, rng: np.random.Generator, noise: float) -> Frame:
    motion = Motion(
        so3.exp(rng.uniform(0.0, np.pi) * _direction(rng)),
        rng.normal(size=3),
        np.radians(_HARD_TURN) * _direction(rng),
        _HARD_WAY * _direction(rng),
    )
    pixels = _uniform_pixels(camera, _POINTS, rng)
    points = _seen_at(motion, camera, pixels, rng.uniform(*_DEPTH, _POINTS))
    pixels += noise * rng.normal(size=pixels.shape)
    wrong = round(_OUTLIERS * _POINTS)
    pixels[:wrong] = _uniform_pixels(camera, wrong, rng)
    return Frame(points, pixels)


def _evenly(count: int, wanted: int) -> list[int]:
    """So many indices below ``count``, spread evenly."""
    return [int(i) for i in np.unique(np.linspace(0, count - 1, min(wanted, count)).astype(int))]


def _uniform_pixels(view: Camera, count: int, rng: np.random.Generator) -> Array:
    """Pixels (count,2) anywhere in the image."""
    return rng.uniform(-0.5, np.array(view.size) - 0.5, (count, 2))


def _seen_at(motion: Motion, view: Camera, pixels: Array, depth: Array) -> Array:
    """Points (n,3) in the map that are seen at pixels (n,2), each at the time of its row."""
    rotations, translations = motion.at_rows(view.row_time(pixels))
    local = depth[:, None] * np.column_stack([view.rays(pixels), np.ones(len(pixels))])
    points: Array = np.einsum("nji,nj->ni", rotations, local - translations)
    return points


def _direction(rng: np.random.Generator) -> Array:
    """Any unit vector (3,)."""
    vector = rng.normal(size=3)
    unit: Array = vector / np.linalg.norm(vector)
    return unit
