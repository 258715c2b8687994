# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.real aria FOLDER``: a head's real motion before its room's real points.

FOLDER is the ``trajectory`` of a recording of Aria's MPS: ``closed_loop_trajectory.csv`` (1 kHz
poses of the device) and ``global_points.csv.gz`` or ``semidense_points.csv.gz``; or a trajectory of
anything as text, which gets points all around. The body's axes are taken for those of a
rolling-shutter camera; pixels are projected row by row by the second simulator, which shares no
line with what is judged.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation, RotationSpline

from benchmarks.aided import believed
from benchmarks.experiments.results import Table, rounded
from benchmarks.independent.cameras import Camera as TrueCamera
from benchmarks.real.peers import PEERS
from benchmarks.real.recordings import Frame, Recording
from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.core.types import Estimate
from rs_localizer.inertial.gyro_prior import GyroscopeTrack
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.status import InertialSettings
from rs_localizer.io.trajectories import read_tum, split_at_gaps
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

_MARGIN = 2.0  # px from the rim
_NEAREST, _FARTHEST = 0.3, 30.0  # m
_INSIDE = 12.592  # 95 % quantile of chi-squared with six degrees of freedom
_RATE = 30.0  # Hz
HELD = ", held"  # poses without a prediction
AHEAD = (0.01, 0.03, 0.1)  # s after the middle of an image, for which the tracker is asked
EPOCH_NS = 10**12  # of times of motions, by the clock of the stamps
_EVERY = 0.001  # s, within rows and between images
# Of a gyroscope: rad/s/sqrt(Hz); rad/s; s; ns from a reading to who asks for it.
_GYROSCOPE_NOISE, _BIAS, _EARLY = math.radians(0.01), math.radians(0.5), 0.004
_LATENCY_NS = 4_000_000
_ROOM, _POINTS = 3.0, 20_000  # m about a trajectory
_BAND, _TONES, _SHORT_SPACING = (4.0, 40.0), 24, 0.002  # Hz of shaking; s
_SPACING = 0.005  # s, of the samples of a trajectory
_EXPECTED = ("tx_world_device", "ty_world_device", "tz_world_device", "qx_world_device",
             "qy_world_device", "qz_world_device", "qw_world_device")  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """A trajectory through poses; map_from_camera."""

    start: float  # s
    end: float
    turns: RotationSpline
    places: CubicSpline

    @classmethod
    def of(cls, times: Array, turns: Rotation, places: Array) -> Motion:
        """Through poses at times (n,) s."""
        spline = RotationSpline(times, turns)
        return cls(float(times[0]), float(times[-1]), spline, CubicSpline(times, places))

    def poses(self, times: Array) -> tuple[Array, Array]:
        """Rotations (n,3,3) and places (n,3)."""
        return self.turns(times).as_matrix(), self.places(times)

    def twist(self, time: float) -> tuple[Array, Array]:
        """Angular and linear velocity in camera axes, rad/s and m/s."""
        # SciPy's spline has its rates in the axes of the body.
        return self.turns(time, 1), self.turns(time).inv().apply(self.places(time, 1))


def read_aria(folder: Path) -> tuple[Motion, Array]:
    """Motion and points (n,3) of a folder of Aria's MPS.

    Raises:
        ValueError: for one without these files or columns.
    """
    path = folder / "closed_loop_trajectory.csv"
    points = [folder / f"{name}_points.csv.gz" for name in ("semidense", "global")]
    cloud = next((file for file in points if file.is_file()), None)
    if not path.is_file() or cloud is None:
        raise ValueError(f"{folder} needs {path.name} and {points[0].name}")
    table = np.genfromtxt(path, delimiter=",", names=True)
    names = table.dtype.names or ()
    missing = [name for name in ("tracking_timestamp_us", *_EXPECTED) if name not in names]
    if missing:
        raise ValueError(f"{path} lacks the columns {', '.join(missing)}")
    values = np.column_stack([table[name] for name in _EXPECTED])
    times = 1e-6 * (table["tracking_timestamp_us"] - table["tracking_timestamp_us"][0])
    # Some samples are a microsecond apart: a spline through them swings.
    kept = np.unique(np.searchsorted(times, np.arange(0.0, times[-1], _SPACING)))
    motion = Motion.of(times[kept], Rotation.from_quat(values[kept, 3:]), values[kept, :3])
    landmarks = np.genfromtxt(cloud, delimiter=",", names=True)
    return motion, np.column_stack([landmarks[f"p{axis}_world"] for axis in "xyz"])


def read_trajectory(path: Path) -> tuple[Motion, Array]:
    """The longest part without a gap of a text of poses, and points (n,3) all around it."""
    part = max(split_at_gaps(read_tum(path)), key=len)
    seconds = 1e-9 * (part.stamps_ns - part.stamps_ns[0])
    motion = Motion.of(seconds, Rotation.from_quat(part.quaternions), part.positions)
    low, high = part.positions.min(axis=0) - _ROOM, part.positions.max(axis=0) + _ROOM
    return motion, np.random.default_rng(0).uniform(low, high, (_POINTS, 3))


def shaken(motion: Motion, size: float, seed: int = 0) -> Motion:
    """The same, shaken about all axes over a broad band: ``size`` rad/s, root mean square."""
    rng, times = np.random.default_rng(seed), np.arange(motion.start, motion.end, _SHORT_SPACING)
    rates = 2.0 * np.pi * np.geomspace(*_BAND, _TONES)
    amplitudes = size * np.sqrt(2.0 / 3.0 / _TONES) / rates
    angles = np.zeros((len(times), 3))
    for rate, amplitude in zip(rates, amplitudes, strict=True):
        angles += amplitude * np.sin(rate * times[:, None] + rng.uniform(0.0, 2.0 * np.pi, 3))
    return Motion.of(
        times, motion.turns(times) * Rotation.from_rotvec(angles), motion.places(times)
    )


def simulated(
    name: str, motion: Motion, points: Array, camera: TrueCamera, count: int, noise: float,
    seed: int = 0,
) -> Recording:  # fmt: skip
    """Images of a moving camera: each point where its row sees it, ``count`` of them."""
    rng, frames = np.random.default_rng(seed), []
    stamps = np.arange(motion.start + 0.1, motion.end - 0.2, 1.0 / _RATE)
    for stamp in stamps:
        rotation, place = motion.poses(np.array([stamp + 0.5 * camera.readout_time]))
        local = (points - place[0]) @ rotation[0]
        near = (local[:, 2] > _NEAREST) & (local[:, 2] < _FARTHEST)
        wide = np.abs(local[:, :2]) < local[:, 2:] * np.array([camera.width, camera.height]) / (
            1.8 * camera.focal
        )
        chosen = np.flatnonzero(near & wide.all(axis=1))
        chosen = rng.choice(chosen, min(3 * count, len(chosen)), replace=False)

        def local_at(delay: Array, stamp: float = stamp, chosen: IntArray = chosen) -> Array:
            turns, places = motion.poses(stamp + delay)
            moved: Array = np.einsum("nji,nj->ni", turns, points[chosen] - places)
            return moved

        pixels = camera.project_rolling(local_at, (len(chosen),))
        size = np.array([camera.width, camera.height]) - 1.0
        inside = np.all((pixels > _MARGIN) & (pixels < size - _MARGIN), axis=1)
        kept = np.flatnonzero(inside)[:count]
        shown = pixels[kept] + noise * rng.normal(size=(len(kept), 2))
        middle = round(1e9 * (stamp + 0.5 * camera.readout_time)) + EPOCH_NS
        frames.append(Frame(middle, points[chosen[kept]], shown))
    return Recording(name, believed(camera), frames)


@dataclass(frozen=True, slots=True)
class Row:
    """Medians, and 95 % quantiles, of errors: deg, mm, deg/s, m/s; shares inside 95 % regions."""

    localized: int
    errors: Array  # (4,2)
    inside: tuple[float, float]


def judge(recording: Recording, motion: Motion) -> dict[str, Row]:
    """Peers, single frames, and tracked ones at once and some frames later."""
    camera, frames = recording.camera, recording.frames
    rows = {}
    for name, peer in PEERS.items():
        poses = [peer(camera, frame.points, frame.pixels) for frame in frames]
        errors = [
            [*_pose_error(pose.rotation, pose.position, motion, _seconds(frame.middle_ns)),
             np.nan, np.nan]
            for pose, frame in zip(poses, frames, strict=True) if pose
        ]  # fmt: skip
        rows[name] = Row(len(errors), _percentiles(np.array(errors)), (np.nan, np.nan))
    localizer = Localizer(camera)
    single = [(frame.middle_ns, localizer.localize(frame.points, frame.pixels)) for frame in frames]
    rows["single"] = _row([(ns, one) for ns, one in single if one], camera, motion)
    for lag in (0, 1, 2):
        tracker = Tracker(Localizer(camera), output_lag=lag)
        found = [tracker.localize(each.middle_ns, each.points, each.pixels) for each in frames]
        tracked = [(one.time_ns, one) for one in [*found, *tracker.flush()] if one]
        rows[f"tracked, {lag} later" if lag else "tracked"] = _row(tracked, camera, motion)
    return rows


def gyroscope(motion: Motion, rate: float, seed: int = 0) -> ImuSamples:
    """What a gyroscope beside the camera shows: with noise and a bias, stamps 4 ms early."""
    rng, times = np.random.default_rng(seed), np.arange(motion.start, motion.end, 1.0 / rate)
    noise = _GYROSCOPE_NOISE * math.sqrt(rate) * rng.normal(size=(len(times), 3))
    rates = np.array([motion.twist(time)[0] for time in times])
    stamps = np.rint(1e9 * (times - _EARLY)).astype(np.int64) + EPOCH_NS
    return ImuSamples(stamps, rates + _BIAS * rng.normal(size=3) + noise)


def _until(samples: ImuSamples | None, time_ns: int) -> ImuSamples | None:
    """The samples that have come until then."""
    if samples is None:
        return None
    end = int(samples.times_ns.searchsorted(time_ns - _LATENCY_NS - round(1e9 * _EARLY)))
    begin = max(end - 300, 0)
    return ImuSamples(samples.times_ns[begin:end], samples.angular_velocity[begin:end])


def at_any_time(
    recording: Recording, motion: Motion, samples: ImuSamples | None = None
) -> dict[str, Row]:
    """``Tracker.at`` within rows, between images and ahead; beside poses held, and moved on as the
    last image moved. A gyroscope's samples come some milliseconds late.
    """
    settings = InertialSettings(_GYROSCOPE_NOISE, _GYROSCOPE_NOISE)
    camera = recording.camera
    aid = None if samples is None else GyroscopeTrack(settings, camera.readout_time)
    tracker = Tracker(Localizer(camera), aid)
    found: dict[str, list[tuple[int, Estimate]]] = {}
    before: Estimate | None = None
    half = round(0.5e9 * camera.readout_time)
    for each in recording.frames:
        imu = _until(samples, each.middle_ns + half + 5 * _LATENCY_NS)
        one = tracker.localize(each.middle_ns, each.points, each.pixels, readings=imu)
        if not one:
            continue
        asked = [("within rows", half * k // 8) for k in range(-8, 9)]
        if before is not None:
            gap = range(before.time_ns + half - each.middle_ns, -half, round(1e9 * _EVERY))
            asked += [("between images", later) for later in gap]
        asked += [(f"{1e3 * ahead:.0f} ms ahead", round(1e9 * ahead)) for ahead in AHEAD]
        for name, later in asked:
            there = tracker.at(each.middle_ns + later, _until(samples, each.middle_ns + later))
            others: dict[str, Estimate | None] = {"": there}
            if later > half:
                others |= {HELD: one, ", same velocity": one.at_time(1e-9 * later)}
            for how, estimate in others.items():
                if estimate is not None:
                    found.setdefault(name + how, []).append((each.middle_ns + later, estimate))
        before = one
    rows = {name: _row(some, camera, motion) for name, some in found.items()}
    for name, row in rows.items():
        if name.endswith(HELD):  # a pose alone, without a twist or a region
            row.errors[2:] = np.nan
            rows[name] = replace(row, inside=(np.nan, np.nan))
    return rows


def _seconds(middle_ns: int) -> float:
    return 1e-9 * (middle_ns - EPOCH_NS)


def _pose_error(
    rotation: Array, position: Array, motion: Motion, time: float
) -> tuple[float, float]:
    turns, places = motion.poses(np.array([time]))
    turn = Rotation.from_matrix(rotation @ turns[0]).magnitude()
    return float(np.degrees(turn)), 1e3 * float(np.linalg.norm(position - places[0]))


def _row(found: Sequence[tuple[int, Estimate]], camera: Camera, motion: Motion) -> Row:
    errors, lengths = [], []
    for middle_ns, one in found:
        time = _seconds(middle_ns)
        turns, places = motion.poses(np.array([time]))
        angular, linear = motion.twist(time)
        turn = Rotation.from_matrix(one.rotation @ turns[0]).as_rotvec()
        off = np.concatenate([
            turn, one.rotation @ (places[0] - one.position),
            camera.readout_time * angular - one.angular_velocity,
            camera.readout_time * linear - one.linear_velocity,
        ])  # fmt: skip
        covariance = one.covariance
        lengths.append([
            off[part] @ np.linalg.solve(covariance[part, part], off[part])
            for part in (slice(0, 6), slice(6, 12))
        ])  # fmt: skip
        errors.append([
            *_pose_error(one.rotation, one.position, motion, time),
            np.degrees(np.linalg.norm(off[6:9])) / camera.readout_time,
            np.linalg.norm(off[9:]) / camera.readout_time,
        ])  # fmt: skip
    inside = np.mean(np.array(lengths) < _INSIDE, axis=0)
    return Row(len(found), _percentiles(np.array(errors)), (float(inside[0]), float(inside[1])))


def _percentiles(errors: Array) -> Array:
    found: Array = np.percentile(errors, [50, 95], axis=0).T
    return found


def table(rows: dict[str, Row]) -> Table:
    """Errors, median and 95 %, and how many truths (%) lie inside the regions of 95 %."""
    return Table(("", "poses", "deg", "mm", "deg/s", "m/s", "inside"), [
        (
            name, row.localized,
            *(f"{rounded(a)}, {rounded(b)}" if np.isfinite(a) else "" for a, b in row.errors),
            ", ".join(f"{100.0 * x:.0f}" for x in row.inside if np.isfinite(x)),
        )
        for name, row in rows.items()
    ])  # fmt: skip


def main(argv: Sequence[str]) -> None:
    """Run it."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.real aria", description=__doc__)
    parser.add_argument("folder", type=Path, help="Aria's, or a text of poses")
    parser.add_argument("--shake", type=float, default=0.0, help="deg/s, root mean square")
    parser.add_argument("--seconds", type=float, default=math.inf, help="of it, at most")
    parser.add_argument("--readout-time", type=float, default=0.016, help="s")
    parser.add_argument("--points", type=int, default=150, help="of each image")
    parser.add_argument("--noise", type=float, default=0.5, help="px")
    parser.add_argument("--gyroscope", type=float, default=0.0, help="Hz of one for any time")
    args = parser.parse_args(argv)
    read = read_aria if args.folder.is_dir() else read_trajectory
    motion, points = read(args.folder)
    if args.shake > 0.0:
        motion = shaken(motion, math.radians(args.shake))
    motion = replace(motion, end=min(motion.end, motion.start + args.seconds))
    camera = TrueCamera(readout_time=args.readout_time)
    recording = simulated(args.folder.name, motion, points, camera, args.points, args.noise)
    samples = gyroscope(motion, args.gyroscope) if args.gyroscope > 0.0 else None
    rows = judge(recording, motion) | at_any_time(recording, motion, samples)
    print(table(rows).text())
