# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Two methods on the same recording: answers, how far they are from the truth, and a table."""

import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.shutter import Motion, project_rolling
from rs_localizer.io.bags import open_bag
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.recording import CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC, IMAGE_TOPIC
from rs_localizer.io.trajectories import Motions, Trajectory, Twists, read_motions
from rs_localizer.tools.evaluation.metrics import (
    Errors,
    Stamps,
    associate,
    pose_errors,
    twist_errors,
)
from rs_localizer.tools.simulation.recording import TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC

# Truth and estimate are meant for the very same moment; a nanosecond may go in rounding.
_TOLERANCE_NS = 1000


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """The frames of a recording of this package, and the truth if it holds one."""

    stamps_ns: list[int]
    camera_infos: list[Any]  # sensor_msgs/CameraInfo of each frame
    clouds: list[Any]  # sensor_msgs/PointCloud2 of each frame
    images: dict[int, Any]  # sensor_msgs/CompressedImage by stamp
    truth: Motions | None


def load_recording(path: Path, most_frames: int | None = None) -> Recording:
    """Read a recording made by ``simulate`` or ``detect``, or its first frames.

    Raises:
        BagError: when it cannot be read.
    """
    infos: list[Any] = []
    clouds: list[Any] = []
    images: dict[int, Any] = {}
    with open_bag(path) as bag:
        topics = {CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC} | ({IMAGE_TOPIC} & set(bag.topics))
        info = None
        for topic, _, message in bag.messages(topics):
            if topic == CAMERA_INFO_TOPIC:
                info = message
            elif topic == IMAGE_TOPIC:
                images[stamp_ns(message)] = message
            elif most_frames is None or len(clouds) < most_frames:
                infos.append(info)
                clouds.append(message)
        has_truth = TRUE_POSE_TOPIC in bag.topics
    truth = read_motions(path, TRUE_POSE_TOPIC, TRUE_TWIST_TOPIC) if has_truth else None
    return Recording([stamp_ns(cloud) for cloud in clouds], infos, clouds, images, truth)


@dataclass(frozen=True, slots=True, eq=False)
class Answer:
    """What a node published for one frame."""

    input_stamp_ns: int
    latency: float  # s from publishing the correspondences to the arrival of the pose
    stamp_ns: int  # of the pose
    position: Array  # (3,) m
    quaternion: Array  # (4,) x y z w
    angular: Array | None  # (3,) rad/s
    linear: Array | None  # (3,) m/s
    residuals: Array  # (k,) px, of the inliers

    def motion(self, readout_time: float) -> Motion:
        """The motion that an answer for the middle row tells of; still without a twist."""
        rotation = Rotation.from_quat(self.quaternion).as_matrix().T
        still = np.zeros(3)
        return Motion(
            rotation,
            -rotation @ self.position,
            still if self.angular is None else readout_time * self.angular,
            still if self.linear is None else readout_time * self.linear,
        )


@dataclass(frozen=True, slots=True, eq=False)
class Result:
    """All answers of one method to one recording."""

    answers: dict[int, Answer]  # by the stamp of the frame
    poses: Trajectory
    errors: Errors | None  # of the poses; with the true angular rate
    twist_errors: Errors | None

    @property
    def inlier_counts(self) -> Array:
        """Inliers (n,) of the localized frames."""
        return np.array([float(len(a.residuals)) for a in self.answers.values()])

    @property
    def residuals(self) -> Array:
        """Residual (n,) of the inliers of each localized frame, px rms."""
        return np.array([np.sqrt(np.mean(a.residuals**2)) for a in self.answers.values()])

    @property
    def latencies(self) -> Array:
        """Seconds (n,)."""
        return np.array([a.latency for a in self.answers.values()])


def compare(answers: dict[int, Answer], truth: Motions | None) -> Result:
    """Put the answers of a method beside the truth, where there is one."""
    answers = dict(sorted(answers.items()))
    listed = list(answers.values())
    poses = Trajectory(
        _stamps(listed),
        np.array([a.position for a in listed]).reshape(-1, 3),
        np.array([a.quaternion for a in listed]).reshape(-1, 4),
    )
    if truth is None:
        return Result(answers, poses, None, None)
    errors = pose_errors(poses, truth.poses, _TOLERANCE_NS)
    errors = replace(errors, true_angular_rate=_rates(errors.stamps_ns, truth.twists))
    moving = [a for a in listed if a.angular is not None and a.linear is not None]
    off = None
    if moving and truth.twists is not None:
        twists = Twists(
            _stamps(moving),
            np.array([a.angular for a in moving]),
            np.array([a.linear for a in moving]),
        )
        off = twist_errors(twists, truth.twists, _TOLERANCE_NS)
    return Result(answers, poses, errors, off)


def counts_at(result: Result, stamps_ns: Sequence[int]) -> Array:
    """Inliers (n,) of the frames with these stamps; 0 where a frame was not localized."""
    answers = result.answers
    return np.array([float(len(answers[s].residuals)) if s in answers else 0.0 for s in stamps_ns])


def true_rates(recording: Recording) -> Array:
    """How fast the camera truly turns (n,), deg/s, at the stamps of the frames; NaN: unknown."""
    stamps = np.array(recording.stamps_ns, np.int64)
    return _rates(stamps, None if recording.truth is None else recording.truth.twists)


def _rates(stamps_ns: Stamps, twists: Twists | None) -> Array:
    rates = np.full(len(stamps_ns), np.nan)
    if twists is not None:
        rows, true_rows = associate(stamps_ns, twists.stamps_ns, _TOLERANCE_NS)
        rates[rows] = np.degrees(np.linalg.norm(twists.angular[true_rows], axis=1))
    return rates


def _stamps(answers: list[Answer]) -> NDArray[np.int64]:
    return np.array([answer.stamp_ns for answer in answers], dtype=np.int64)


def predicted_pixels(camera: Camera, answer: Answer, points: Array) -> Array:
    """Raw pixels (n,2) where an answer for the middle row puts points (n,3).

    Without a twist the camera stands still.
    """
    return project_rolling(camera, answer.motion(camera.readout_time).at_rows, points)[0]


_LABEL, _CELL = 44, 17
# What a row says of a method that has no such thing.
_NONE = "-"

Cell = Callable[[Recording, Result], str]


def table(title: str, recording: Recording, results: Mapping[str, Result]) -> str:
    """The results of several methods, by name, side by side; 80 columns hold two of them."""
    names = [textwrap.wrap(name, _CELL - 2) for name in results]
    lines = [
        f"{left:{_LABEL}}" + "".join(f"{part:>{_CELL}}" for part in parts)
        for left, *parts in zip_longest([title], *names, fillvalue="")
    ]
    for label, cell in _ROWS:
        cells = [cell(recording, result) for result in results.values()]
        if any(text != _NONE for text in cells):
            lines.append(f"  {label:{_LABEL - 2}}" + "".join(f"{text:>{_CELL}}" for text in cells))
    return "\n".join(lines)


def _localized(recording: Recording, result: Result) -> str:
    share = len(result.answers) / len(recording.stamps_ns)
    return f"{len(result.answers)} ({100.0 * share:.1f} %)"


def _latency(_: Recording, result: Result) -> str:
    if not result.answers:
        return _NONE
    p50, p95 = np.percentile(1e3 * result.latencies, [50, 95])
    return f"{p50:.1f} / {p95:.1f}"


def _error(
    of: Callable[[Result], Errors | None], kind: str, digits: int, *, unit: float = 1.0,
    least_rate: float = 0.0,
) -> Cell:  # fmt: skip
    """Median over the frames in which the camera turns faster than ``least_rate`` (deg/s)."""

    def cell(_: Recording, result: Result) -> str:
        errors = of(result)
        if errors is None:
            return _NONE
        values = unit * getattr(errors, kind)
        if least_rate > 0.0:
            values = values[errors.true_angular_rate > least_rate]
        return _median(values, digits)

    return cell


def _median(values: Array, digits: int) -> str:
    return f"{np.median(values):.{digits}f}" if len(values) else _NONE


_POSITION = partial(_error, lambda result: result.errors, "linear", 1, unit=1e3)
_ORIENTATION = partial(_error, lambda result: result.errors, "angular", 3)
_TURN_RATE = partial(_error, lambda result: result.twist_errors, "angular", 1)
_VELOCITY = partial(_error, lambda result: result.twist_errors, "linear", 2)

_ROWS: tuple[tuple[str, Cell], ...] = (
    ("frames", lambda recording, _: str(len(recording.stamps_ns))),
    ("localized", _localized),
    (
        "points in a frame, median",
        lambda recording, _: _median(np.array([float(c.width) for c in recording.clouds]), 0),
    ),
    ("inliers, median", lambda _, result: _median(result.inlier_counts, 0)),
    ("residual of the inliers, median (px rms)", lambda _, result: _median(result.residuals, 3)),
    ("position error, median (mm)", _POSITION()),
    ("  where the camera turns > 60 deg/s", _POSITION(least_rate=60.0)),
    ("  where the camera turns > 150 deg/s", _POSITION(least_rate=150.0)),
    ("orientation error, median (deg)", _ORIENTATION()),
    ("  where the camera turns > 60 deg/s", _ORIENTATION(least_rate=60.0)),
    ("  where the camera turns > 150 deg/s", _ORIENTATION(least_rate=150.0)),
    ("angular velocity error, median (deg/s)", _TURN_RATE()),
    ("  where the camera turns > 150 deg/s", _TURN_RATE(least_rate=150.0)),
    ("linear velocity error, median (m/s)", _VELOCITY()),
    ("latency, 50 / 95 % (ms)", _latency),
)
