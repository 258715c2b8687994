# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How well a recording tells the readout time of its camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from benchmarks.data import HAND_MOTION
from benchmarks.experiments.results import Context, Result, limited
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools import verdict
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.camera_calibration import CameraCalibration, calibrate
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import frame_stamps, simulate_frames
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion

_RATE = 30.0  # Hz
_TRIALS_PER_RECORDING = 50  # 40 recordings at 2000 trials
_LEAST, _MOST = 8, 40
_GLOBAL = 8  # every so many-th recording is of a global shutter
_NOISE, _POINTS = 0.5, 100
_TRIALS_PER_SECOND, _SHORTEST, _LONGEST = 250, 2.0, 6.0  # s of each recording
_READOUT_TIMES = (0.005, 0.011, 0.017, 0.03)
_OUTLIERS = (0.0, 0.2, 0.4)
_WALL_DISTANCE, _WALL_SIZE, _WALL_POINTS = 2.0, 16.0, 40_000  # m, m, one
_CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    np.array([-0.1, 0.05, 0.001, 0.001, 0.0]),
)  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One recording."""

    truth: float  # s
    found: CameraCalibration

    @property
    def error(self) -> float:
        """s."""
        return self.found.readout_time - self.truth

    @property
    def bound(self) -> float:
        """Cramér-Rao bound of its inliers, s."""
        fit = self.found.fit
        return float(fit.readout_time_deviation / np.sqrt(fit.inflation) * _NOISE / fit.deviation)


def run(context: Context) -> Result:
    """Recordings of some seconds from the recorded motion of a hand, 30 images of 640x480 a second.

    Up to 100 points with 0.5 px noise in a room or on one wall, 0 to 40 % outliers, readout times
    of 5 to 30 ms in all four directions, and global shutters; lens known to 2 %, estimated along.
    """
    count = int(np.clip(context.trials // _TRIALS_PER_RECORDING, _LEAST, _MOST))
    motion = RecordedMotion(read_tum(HAND_MOTION))
    seconds = float(np.clip(context.trials / _TRIALS_PER_SECOND, _SHORTEST, _LONGEST))
    trials = [_trial(motion, seconds, k, context.seed) for k in context.track(range(count), count)]
    moving = [trial for trial in trials if trial.truth > 0.0]
    ratio = np.sqrt(np.mean([(trial.error / trial.bound) ** 2 for trial in moving]))
    inside = [abs(trial.error) < 1.96 * trial.found.deviation for trial in trials]
    still = [trial.found.global_shutter for trial in trials if trial.truth == 0.0]
    taken = [verdict.readout_time(trial.found) == 0.0 for trial in moving]
    said = (
        f"{count} recordings of {seconds:g} s: median error "
        f"{1e6 * np.median([abs(t.error) for t in moving]):.0f} us, {ratio:.2f} of the "
        f"Cramér-Rao bound (rms);\n{np.mean(inside):.0%} inside the intervals of 95 %; "
        f"{sum(still)} of {len(still)} global shutters named, {sum(taken)} of {len(moving)} "
        "others called one"
    )
    return Result(
        [
            limited(
                "readout-time.bound", "the readout time is as good as the keypoints allow",
                "rms error over the Cramér-Rao bound", float(ratio), most=1.15,
                why=f"{count} recordings know the ratio to {50 / np.sqrt(count / 2):.0f} %",
            ),
            limited(
                "readout-time.coverage", "its deviation is honest",
                "share of the 95 % intervals that hold", float(np.mean(inside)), least=0.9,
            ),
            limited(
                "readout-time.direction", "the direction is always right",
                "recordings with the wrong sign", sum(t.found.readout_time < 0.0 for t in moving),
                most=0.0,
            ),
            limited(
                "readout-time.global", "a global shutter is one, and no rolling shutter is",
                "mistakes", len(still) - sum(still) + sum(taken), most=0.0,
            ),
        ],
        [said],
    )  # fmt: skip


def _trial(motion: RecordedMotion, seconds: float, k: int, seed: int) -> Trial:
    rng = np.random.default_rng([seed, k])
    truth = 0.0 if k % _GLOBAL == _GLOBAL - 1 else _READOUT_TIMES[k % len(_READOUT_TIMES)]
    direction = list(ScanDirection)[(k // 2) % 4]
    outliers = _OUTLIERS[k % len(_OUTLIERS)]
    scene = ("room", "wall")[k % 5 == 2]
    camera = replace(_CAMERA, readout_time=truth, scan_direction=direction)
    stamps = frame_stamps(motion, camera, _RATE)
    wanted = int(seconds * _RATE)
    first = int(rng.integers(len(stamps) - wanted)) if scene == "room" else 0
    stamps = stamps[first : first + wanted]
    settings = FrameSettings(points=_POINTS, noise=_NOISE, outliers=outliers, rate=_RATE)
    points = _map(motion, scene, rng)
    frames = simulate_frames(camera, motion, points, settings, stamps_ns=stamps, seed=k)
    images = [ImagePoints(frame.stamp_ns, frame.points, frame.pixels) for frame in frames]
    found = calibrate(replace(camera, readout_time=0.0), images)
    return Trial(truth, found)


def _map(motion: RecordedMotion, scene: str, rng: np.random.Generator) -> Array:
    first, last = motion.intervals_ns[0]
    way = motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 400)).positions
    if scene == "room":
        return room(way, rng)
    # Across x, along which the camera looks in the first seconds.
    y, z = rng.uniform(-0.5 * _WALL_SIZE, 0.5 * _WALL_SIZE, (2, _WALL_POINTS))
    x = np.full(_WALL_POINTS, way[:, 0].max() + _WALL_DISTANCE)
    return np.column_stack([x, y + way[:, 1].mean(), z + way[:, 2].mean()])
