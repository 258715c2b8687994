# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscopes that are held back as a truth: of a text, or inside a video of a board."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.real.clips import clip_of, opencv_lens, shutter_of
from benchmarks.real.peers import solve_pnp
from benchmarks.real.recordings import Frame, Recording
from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.io.telemetry import has_telemetry, read_telemetry
from rs_localizer.markers.prints import Chessboard
from rs_localizer.pipeline.pose_at_time import middle_row_ns

_OFFSETS = np.arange(-0.5, 0.5, 0.004)  # s, by which clocks of one device may differ
_FEWEST = 20  # turns between neighbours that tell of clock, axes and bias
_MOST_IMAGES = 600


@dataclass(frozen=True, slots=True, eq=False)
class Gyroscope:
    """Turn rates (k,3) rad/s in camera axes at times (k,) s."""

    times: Array
    rates: Array

    @classmethod
    def read(cls, path: Path) -> Gyroscope:
        """A text of ``t wx wy wz``; raises ``ValueError`` for another."""
        table = np.atleast_2d(np.loadtxt(path))
        if table.shape[1] != 4 or len(table) < 2 or not np.all(np.diff(table[:, 0]) > 0.0):
            raise ValueError(
                f"{path} must hold lines t wx wy wz (s, rad/s) in the order of time, found "
                f"{table.shape[0]} of {table.shape[1]} numbers"
            )
        return cls(table[:, 0], table[:, 1:])

    def mean_rate(self, first: Array, last: Array) -> Array:
        """Mean rates (n,3) rad/s between times (n,) s."""
        step = 0.5 * (self.rates[1:] + self.rates[:-1]) * np.diff(self.times)[:, None]
        angles = np.vstack([np.zeros(3), np.cumsum(step, axis=0)])

        def at(time: Array) -> Array:
            return np.stack([np.interp(time, self.times, angles[:, k]) for k in range(3)], axis=1)

        rate: Array = (at(last) - at(first)) / (last - first)[:, None]
        return rate


def aligned(gyroscope: Gyroscope, recording: Recording) -> tuple[Gyroscope, str]:
    """By the clock of the stamps, in the camera's axes, and without bias; and what was found.

    Seven numbers for a whole recording, by the turns between neighbouring poses of solvePnP, which
    knows of no shutter: they tell nothing of single images.

    Raises:
        ValueError: where too few neighbours are localized.
    """
    poses = [solve_pnp(recording.camera, each.points, each.pixels) for each in recording.frames]
    times = 1e-9 * np.array([frame.middle_ns for frame in recording.frames])
    pairs = [k for k in range(len(poses) - 1) if poses[k] and poses[k + 1]]
    if len(pairs) < _FEWEST:
        raise ValueError(f"{len(pairs)} pairs of neighbours are localized, {_FEWEST} are needed")
    first, last = times[pairs], times[np.array(pairs) + 1]
    turns = [
        (Rotation.from_matrix(a.rotation) * Rotation.from_matrix(b.rotation).inv()).as_rotvec()
        for a, b in ((poses[k], poses[k + 1]) for k in pairs) if a and b
    ]  # fmt: skip
    seen = np.array(turns) / (last - first)[:, None]

    def rates(offset: float) -> Array:
        return gyroscope.mean_rate(first - offset, last - offset)

    speeds = np.linalg.norm(seen, axis=1)
    alike = [
        np.corrcoef(np.linalg.norm(rates(offset), axis=1), speeds)[0, 1] for offset in _OFFSETS
    ]
    offset = float(_OFFSETS[int(np.argmax(alike))])
    axes, _ = Rotation.align_vectors(seen, rates(offset))

    def errors(numbers: Array) -> Array:
        turned = Rotation.from_rotvec(numbers[1:4]).apply(rates(numbers[0]) - numbers[4:])
        off: Array = (turned - seen).ravel()
        return off

    noise = max(float(np.median(np.abs(errors(np.r_[offset, axes.as_rotvec(), 0, 0, 0])))), 1e-4)
    found = least_squares(
        errors, np.r_[offset, axes.as_rotvec(), np.zeros(3)], loss="soft_l1", f_scale=noise,
        x_scale=np.r_[1e-3, np.full(6, 1e-2)],
    ).x  # fmt: skip
    turned = Rotation.from_rotvec(found[1:4]).apply(gyroscope.rates - found[4:])
    angle, bias = np.degrees(np.linalg.norm(found[1:].reshape(2, 3), axis=1))
    said = f"gyroscope: {1e3 * found[0]:+.1f} ms, turned by {angle:.1f} deg, bias {bias:.2f} deg/s"
    return Gyroscope(gyroscope.times + found[0], turned), said


def read_board_video(
    path: Path, board: Chessboard, config: NodeConfig, cache: Path
) -> tuple[Recording, Gyroscope]:
    """Images of a video before a board, and the gyroscope inside it.

    The readout time is the configured one, else the file's, else that of ``calibrate``.

    Args:
        cache: where corners and calibration are kept.

    Raises:
        ValueError: without a gyroscope, or with a stabilizer that has moved the rows.
    """
    telemetry = read_telemetry(path) if has_telemetry(path) else None
    if telemetry is None:
        raise ValueError(f"{path} has no gyroscope inside; give a text of t wx wy wz: --gyroscope")
    if telemetry.stabilizer:
        raise ValueError(f"{path} is stabilized ({telemetry.stabilizer}): film with it off")
    clip = clip_of(path, board, cache, _MOST_IMAGES)
    readout, direction = config.readout_time or telemetry.readout_time, config.scan_direction
    if not readout:
        shutter = shutter_of(clip, cache)
        readout, direction = shutter.readout_time, shutter.scan_direction
    config = replace(config, readout_time=readout)
    camera = replace(opencv_lens(clip), readout_time=readout, scan_direction=direction)
    frames = [
        Frame(middle_row_ns(config, camera, image.stamp_ns), image.points, image.pixels)
        for image in clip.images
    ]
    return Recording(path.stem, camera, frames), Gyroscope(telemetry.times, telemetry.rates)
