# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How well a recording tells the readout time of its camera."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from matplotlib.figure import Figure

from benchmarks.data import HAND_MOTION
from benchmarks.experiments import charts
from benchmarks.experiments.results import Claim, Context, Result, Statement, Table
from benchmarks.experiments.uncertainty import share
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.trajectories import read_tum
from rs_localizer.tools import verdict
from rs_localizer.tools.adjust.observe import Observed
from rs_localizer.tools.calibration import Calibration, calibrate
from rs_localizer.tools.simulation.frames import frame_stamps, simulate_frames
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import RecordedMotion

_SPECIFICATION = "our issue"
_RATE = 30.0  # Hz
# The recording whose faults are looked at.
_TRUTH, _START = 0.02, 30  # s
_SETTINGS = FrameSettings(points=100, noise=0.5, outliers=0.2, rate=_RATE)
_JITTER, _MISSING, _FAST = 3e-3, 0.2, 0.01
_FAULT_COLUMNS = ("what", "error_us", "deviation_us", "said")

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
    return claim, Table(_FAULT_COLUMNS, rows)


_TRIALS_PER_RECORDING = 50  # 40 recordings at 2000 trials
_LEAST, _MOST = 8, 40
_GLOBAL = 8  # every so many-th recording is of a global shutter
_NOISE, _POINTS = 0.5, 100
_TRIALS_PER_SECOND, _SHORTEST, _LONGEST = 250, 2.0, 6.0  # s of each recording
_READOUT_TIMES = (0.005, 0.011, 0.017, 0.03)
_OUTLIERS = (0.0, 0.2, 0.4)
_WALL_DISTANCE, _WALL_SIZE, _WALL_POINTS = 2.0, 16.0, 40_000  # m, m, one


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """One recording."""

    scene: str
    direction: ScanDirection
    outliers: float
    truth: float  # s
    found: Calibration

    @property
    def error(self) -> float:
        """s."""
        return self.found.readout_time - self.truth

    @property
    def bound(self) -> float:
        """Cramér-Rao bound of its inliers, s."""
        fit = self.found.fit
        return float(self.found.formal_deviation / np.sqrt(fit.inflation) * _NOISE / fit.deviation)


def run(context: Context) -> Result:
    """The experiment."""
    count = int(np.clip(context.trials // _TRIALS_PER_RECORDING, _LEAST, _MOST))
    motion = RecordedMotion(read_tum(HAND_MOTION))
    seconds = float(np.clip(context.trials / _TRIALS_PER_SECOND, _SHORTEST, _LONGEST))
    trials = [_trial(motion, seconds, k, context.seed) for k in context.track(range(count), count)]
    points = _map(motion, "room", np.random.default_rng([context.seed, count]))
    spoilt, faults = readout_faults(motion, points, seconds, context.seed)
    moving = [trial for trial in trials if trial.truth > 0.0]
    return Result(
        "Readout time",
        f"{count} recordings of {seconds:g} s from the recorded motion of a hand, {_RATE:g} "
        f"images per second of 640x480, up to {_POINTS} points with {_NOISE:g} px noise in a room "
        "or on one wall, 0 to 40 % outliers, readout times of 5 to 30 ms in all four directions, "
        "and global shutters; lens known to 2 %, estimated along. One more, with a fault at a "
        "time.",
        [_efficient(moving), _covered(trials), _directed(moving), _global(trials), spoilt],
        {
            "readout_time": Table(_COLUMNS, [_row(trial) for trial in trials]),
            "readout_faults": faults,
        },
        {"readout_time": _figure(trials)},
    )


_COLUMNS = (
    "scene", "direction", "outliers", "truth_ms", "error_us", "deviation_us", "bound_us",
    "odds_log10",
)  # fmt: skip


def _trial(motion: RecordedMotion, seconds: float, k: int, seed: int) -> Trial:
    rng = np.random.default_rng([seed, k])
    truth = 0.0 if k % _GLOBAL == _GLOBAL - 1 else _READOUT_TIMES[k % len(_READOUT_TIMES)]
    direction = list(ScanDirection)[(k // 2) % 4]
    outliers = _OUTLIERS[k % len(_OUTLIERS)]
    scene = ("room", "wall")[k % 5 == 2]
    K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
    camera = Camera(
        width=640, height=480, K=K, readout_time=truth, scan_direction=direction,
        D=np.array([-0.1, 0.05, 0.001, 0.001, 0.0]),
    )  # fmt: skip
    stamps = frame_stamps(motion, camera, _RATE)
    wanted = int(seconds * _RATE)
    first = int(rng.integers(len(stamps) - wanted)) if scene == "room" else 0
    stamps = stamps[first : first + wanted]
    settings = FrameSettings(points=_POINTS, noise=_NOISE, outliers=outliers, rate=_RATE)
    points = _map(motion, scene, rng)
    frames = simulate_frames(camera, motion, points, settings, stamps_ns=stamps, seed=k)
    images = [Observed(frame.stamp_ns, frame.points, frame.pixels) for frame in frames]
    return Trial(
        scene, direction, outliers, truth, calibrate(replace(camera, readout_time=0.0), images)
    )


def _map(motion: RecordedMotion, scene: str, rng: np.random.Generator) -> Array:
    first, last = motion.intervals_ns[0]
    way = motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 400)).positions
    if scene == "room":
        return room(way, rng)
    # Across x, along which the camera looks in the first seconds.
    y, z = rng.uniform(-0.5 * _WALL_SIZE, 0.5 * _WALL_SIZE, (2, _WALL_POINTS))
    x = np.full(_WALL_POINTS, way[:, 0].max() + _WALL_DISTANCE)
    return np.column_stack([x, y + way[:, 1].mean(), z + way[:, 2].mean()])


def _efficient(trials: list[Trial]) -> Claim:
    ratio = float(np.sqrt(np.mean([(trial.error / trial.bound) ** 2 for trial in trials])))
    return Statement(
        "readout-time.bound",
        _SPECIFICATION,
        "The readout time is as good as the keypoints allow.",
        "rms error at most 1.15 times the Cramér-Rao bound",
    ).judged(
        f"{ratio:.2f} times, {len(trials)} recordings; median error "
        f"{1e6 * np.median([abs(t.error) for t in trials]):.0f} us",
        ratio <= 1.15,
        f"{len(trials)} recordings know the ratio to {50 / np.sqrt(len(trials) / 2):.0f} %",
    )


def _covered(trials: list[Trial]) -> Claim:
    inside = share(np.array([abs(t.error) < 1.96 * t.found.deviation for t in trials]))
    return Statement(
        "readout-time.coverage",
        _SPECIFICATION,
        "Its deviation is honest.",
        "95 % intervals hold at least 90 %",
    ).judged_by(f"{inside.value:.0%} of {len(trials)}", [inside], (0.9, 1.0), "intervals too short")


def _directed(trials: list[Trial]) -> Claim:
    wrong = sum(trial.found.readout_time < 0.0 for trial in trials)
    least = min(trial.found.odds for trial in trials)
    return Statement(
        "readout-time.direction",
        _SPECIFICATION,
        "The direction is always right.",
        "no recording with the wrong sign",
    ).judged(f"{wrong} of {len(trials)}, odds of 10^{least:.0f} and more", wrong == 0)


def _global(trials: list[Trial]) -> Claim:
    still = [trial for trial in trials if trial.truth == 0.0]
    right = sum(trial.found.global_shutter for trial in still)
    false = sum(verdict.readout_time(t.found) == 0.0 for t in trials if t.truth > 0.0)
    return Statement(
        "readout-time.global",
        _SPECIFICATION,
        "A global shutter is one.",
        "0 within the error, and no rolling shutter taken for one",
    ).judged(
        f"{right} of {len(still)}; {false} rolling ones taken for global",
        right == len(still) and false == 0,
    )


def _row(trial: Trial) -> tuple[str | float, ...]:
    return (
        trial.scene, str(trial.direction), trial.outliers, 1e3 * trial.truth, 1e6 * trial.error,
        1e6 * trial.found.deviation, 1e6 * trial.bound, trial.found.odds,
    )  # fmt: skip


def _figure(trials: list[Trial]) -> Figure:
    drawn = charts.figure(7.0, 3.6)
    axes = drawn.subplots()
    place = np.arange(len(trials))
    axes.errorbar(
        place,
        [1e6 * trial.error for trial in trials],
        [1.96e6 * trial.found.deviation for trial in trials],
        fmt=".",
        color="#0b3c8c",
    )
    axes.axhline(0.0, color="#c9c9c9")
    axes.set(xlabel="recording", ylabel="error of the readout time (us), 95 %")
    return drawn
