# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What a recording that is not as it should be does to the readout time, and what is said of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from benchmarks.experiments.results import Claim, Statement, Table
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.simulation.frames import frame_stamps, simulate_frames
from rs_localizer.simulation.settings import FrameSettings
from rs_localizer.simulation.true_motion import RecordedMotion
from rs_localizer.trajectory import verdict
from rs_localizer.trajectory.calibration import calibrate
from rs_localizer.trajectory.observe import Observed

_TRUTH, _RATE, _START = 0.02, 30.0, 30
_SETTINGS = FrameSettings(points=100, noise=0.5, outliers=0.2, rate=_RATE)
_JITTER, _MISSING, _FAST = 3e-3, 0.2, 0.01
_SPECIFICATION = "our issue"
COLUMNS = ("what", "error_us", "deviation_us", "said")

Images = list[Observed]


def _as_it_is(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    return camera, images


def _jitter(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    late = np.round(1e9 * rng.normal(0.0, _JITTER, len(images))).astype(int)
    return camera, [
        replace(image, stamp_ns=image.stamp_ns + int(by))
        for image, by in zip(images, late, strict=True)
    ]


def _missing(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    kept = rng.random(len(images)) > _MISSING
    return camera, [image for image, keep in zip(images, kept, strict=True) if keep]


def _second(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    return camera, images[::2]


def _long(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    return replace(camera, K=camera.K * [[1.01], [1.01], [1.0]]), images


def _straight(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    return replace(camera, D=np.zeros(5)), images


def _fast(camera: Camera, images: Images, rng: np.random.Generator) -> tuple[Camera, Images]:
    first = images[0].stamp_ns
    return camera, [
        replace(image, stamp_ns=first + round((image.stamp_ns - first) * (1.0 + _FAST)))
        for image in images
    ]


Fault = Callable[[Camera, Images, np.random.Generator], tuple[Camera, Images]]
_FAULTS: tuple[tuple[str, Fault], ...] = (
    ("nothing", _as_it_is),
    ("stamps jitter by 3 ms", _jitter),
    ("a fifth of the images missing", _missing),
    ("every second image only", _second),
    ("focal length given 1 % too long", _long),
    ("no distortion given", _straight),
    ("stamps run 1 % fast", _fast),
)


def readout_faults(
    motion: RecordedMotion, points: Array, seconds: float, seed: int
) -> tuple[Claim, Table]:
    """One recording, whole and with one fault at a time."""
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    camera = Camera(
        width=640, height=480, K=K, D=np.array([-0.1, 0.05, 0.001, 0.001, 0.0]),
        readout_time=_TRUTH,
    )  # fmt: skip
    first = round(_START * _RATE)
    stamps = frame_stamps(motion, camera, _RATE)[first : first + round(seconds * _RATE)]
    frames = simulate_frames(camera, motion, points, _SETTINGS, stamps_ns=stamps, seed=seed)
    images = [Observed(frame.stamp_ns, frame.points, frame.pixels) for frame in frames]
    rows: list[tuple[str | float, ...]] = []
    for what, fault in _FAULTS:
        given, seen = fault(replace(camera, readout_time=0.0), images, np.random.default_rng(seed))
        found = calibrate(given, seen)
        said = verdict.refusal(found) or "; ".join(verdict.remarks(found)[1:])
        error = 1e6 * (found.readout_time - _TRUTH)
        rows.append((what, error, 1e6 * found.deviation, said))
    honest = [row for row in rows if row[0] != "stamps run 1 % fast"]
    worst = max(abs(float(row[1])) / float(row[2]) for row in honest)
    claim = Statement(
        "readout-time.faults",
        _SPECIFICATION,
        "Wrong stamps, a wrong focal length and a wrong distortion do not spoil it.",
        "errors within four deviations, but for stamps that run fast: nothing can tell those",
    ).judged(
        f"{worst:.1f} deviations at worst, of {len(honest)} recordings",
        worst < 4.0,
        "one recording",
    )
    return claim, Table(COLUMNS, rows)
