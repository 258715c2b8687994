# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Trajectory files: TUM poses ``t x y z qx qy qz qw`` and twists ``t wx wy wz vx vy vz``.

Lines may come in any order, with commas, and with NaN where a tracker has lost its target.

Times are seconds in the files and integer nanoseconds here: a float of today's date in seconds
is 240 ns coarse. Files that end in ``.gz`` are compressed text.
"""

from __future__ import annotations

import gzip
import io
import zlib
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import Any, Literal, Self, TextIO

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagReader, is_bag, open_bag
from rs_localizer.io.messages import stamp_ns

# Files round quaternions to four digits or more; what is further from 1 is no rotation.
_QUATERNION_TOLERANCE = 0.01
# Seconds whose nanoseconds fit 64 bits.
_LATEST = 9_223_372_036


class TrajectoryError(ValueError):
    """A trajectory file that cannot be read; the message names the file, the line, the fault."""


@dataclass(frozen=True, slots=True, eq=False)
class _Series:
    """Rows in the order of time."""

    stamps_ns: NDArray[np.int64]  # (n,) strictly increasing

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def part(self, rows: slice | NDArray[np.bool_] | NDArray[np.intp]) -> Self:
        """Return some of the rows."""
        return type(self)(*(getattr(self, each.name)[rows] for each in fields(self)))


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory(_Series):
    """Poses map_from_body in the order of time."""

    positions: Array  # (n,3) m
    quaternions: Array  # (n,4) x y z w, unit


@dataclass(frozen=True, slots=True, eq=False)
class Twists(_Series):
    """Velocities of a body in its own axes, in the order of time."""

    angular: Array  # (n,3) rad/s
    linear: Array  # (n,3) m/s


def read_tum(path: Path | str) -> Trajectory:
    """Read a TUM file.

    Raises:
        TrajectoryError: for a missing, empty or malformed file, or a time of two poses.
    """
    path = Path(path)
    stamps_ns, values = _read_table(path, ("x", "y", "z", "qx", "qy", "qz", "qw"))
    with np.errstate(over="ignore"):
        norms = np.linalg.norm(values[:, 3:], axis=1)
    wrong = np.flatnonzero(np.abs(norms - 1.0) > _QUATERNION_TOLERANCE)
    if len(wrong):
        raise TrajectoryError(
            f"{path}: the quaternion of pose {wrong[0] + 1} has norm {norms[wrong[0]]:.6g}, not 1"
        )
    return Trajectory(stamps_ns, values[:, :3], values[:, 3:] / norms[:, None])


def write_tum(path: Path | str, trajectory: Trajectory, about: Sequence[str] = ()) -> None:
    """Write a TUM file, which reads back the same to the last bit.

    Args:
        about: lines of comment before the data.
    """
    _write_table(path, (*about, "t x y z qx qy qz qw"), trajectory)


def read_twists(path: Path | str) -> Twists:
    """Read a twist file; raises TrajectoryError as :func:`read_tum` does."""
    stamps_ns, values = _read_table(Path(path), ("wx", "wy", "wz", "vx", "vy", "vz"))
    return Twists(stamps_ns, values[:, :3], values[:, 3:])


def write_twists(path: Path | str, twists: Twists, about: Sequence[str] = ()) -> None:
    """Write a twist file as :func:`write_tum` does."""
    _write_table(path, (*about, "t wx wy wz vx vy vz"), twists)


def split_at_gaps(trajectory: Trajectory) -> list[Trajectory]:
    """Split at pauses longer than three times the median spacing.

    A recording that lost track for a while says nothing of the motion meanwhile.
    """
    spacing = np.diff(trajectory.stamps_ns)
    if len(spacing) == 0:
        return [trajectory]
    ends = np.flatnonzero(spacing > 3.0 * np.median(spacing)) + 1
    bounds = [0, *ends.tolist(), len(trajectory)]
    return [trajectory.part(slice(*pair)) for pair in pairwise(bounds)]


def parse_stamp(text: str) -> int:
    """Parse a decimal number of seconds to exact nanoseconds (also ``1.5e9``)."""
    seconds = Decimal(text)
    # Compared first: the integer of 1e999999999 would fill the memory.
    if not seconds.is_finite() or abs(seconds) >= _LATEST:
        raise InvalidOperation
    return int((seconds * 1_000_000_000).to_integral_value())


def format_stamp(stamp_ns: int) -> str:
    """Format seconds with nine decimals."""
    seconds, nanoseconds = divmod(abs(int(stamp_ns)), 1_000_000_000)
    return f"{'-' if stamp_ns < 0 else ''}{seconds}.{nanoseconds:09d}"


def _open(path: Path, mode: Literal["r", "w"]) -> TextIO:
    if path.suffix == ".gz":
        return io.TextIOWrapper(gzip.GzipFile(path, mode), encoding="utf-8")
    return path.open(mode, encoding="utf-8")


def _read_table(path: Path, columns: tuple[str, ...]) -> tuple[NDArray[np.int64], Array]:
    """Return times (ns) and the other columns, without comments, headings and empty lines."""
    stamps, table = array("q"), array("d")  # lists take ten times the memory
    for number, line in _lines(path):
        words = line.replace(",", " ").split()
        try:
            stamp_ns, values = parse_stamp(words[0]), [float(word) for word in words[1:]]
            if len(values) != len(columns):
                raise ValueError
            if np.isnan(values).all():  # a tracker that has lost its target
                continue
            if not np.isfinite(values).all():
                raise ValueError
        except (ValueError, IndexError, InvalidOperation):
            raise TrajectoryError(
                f"{path}, line {number}: expected the finite numbers t {' '.join(columns)}, found "
                f"{line[:80]!r}"
            ) from None
        stamps.append(stamp_ns)
        table.extend(values)
    if not stamps:
        raise TrajectoryError(f"{path} holds no line of numbers")
    order = np.argsort(np.array(stamps), kind="stable")
    times, rows = np.array(stamps)[order], np.reshape(table, (-1, len(columns)))[order]
    again = times[1:] == times[:-1]
    if np.any(unlike := again & np.any(rows[1:] != rows[:-1], axis=1)):
        time = format_stamp(times[1:][unlike][0]).rstrip("0")
        raise TrajectoryError(f"{path}: the time {time} is there twice, with different values")
    first = np.append(True, ~again)
    return times[first], rows[first]


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    try:
        with _open(path, "r") as file:
            for number, line in enumerate(file, start=1):
                stripped = line.strip()
                if stripped and not stripped.startswith("#"):
                    yield number, stripped
    except FileNotFoundError:
        raise TrajectoryError(f"{path} does not exist") from None
    except (OSError, EOFError, UnicodeDecodeError, zlib.error) as error:
        raise TrajectoryError(f"{path} cannot be read as text: {error}") from error


def _write_table(path: Path | str, comments: Iterable[str], rows: Trajectory | Twists) -> None:
    stamps_ns, *values = (getattr(rows, each.name) for each in fields(rows))
    with _open(Path(path), "w") as file:
        file.writelines(f"# {line}\n" for line in comments)
        for stamp_ns, row in zip(stamps_ns, np.hstack(values).tolist(), strict=True):
            file.write(f"{format_stamp(stamp_ns)} {' '.join(map(repr, row))}\n")


POSES_FILE, TWISTS_FILE = "poses.txt", "twists.txt"
"""Names of replay's text files."""

_POSE, _TWIST = "geometry_msgs/msg/PoseStamped", "geometry_msgs/msg/TwistStamped"


@dataclass(frozen=True, slots=True, eq=False)
class Motions:
    """Poses, and twists where there are any."""

    poses: Trajectory
    twists: Twists | None


def read_motions(
    path: Path, pose_topic: str | None = None, twist_topic: str | None = None
) -> Motions:
    """Read poses and twists of a TUM file, a directory made by replay, or a recording.

    Args:
        pose_topic, twist_topic: where a recording has them; default: its only PoseStamped or
            TwistStamped.

    Raises:
        ValueError: when there are none, naming the path and what was found.
    """
    if (path / POSES_FILE).is_file():
        twists = path / TWISTS_FILE
        has_twists = twists.is_file() and next(_lines(twists), None) is not None
        return Motions(read_tum(path / POSES_FILE), read_twists(twists) if has_twists else None)
    if path.is_file() and not is_bag(path):
        return Motions(read_tum(path), None)
    with open_bag(path) as bag:
        pose_topic = bag.find_topic((_POSE,), pose_topic, "-r pose:=TOPIC")
        if twist_topic is not None or _TWIST in bag.topics.values():
            twist_topic = bag.find_topic((_TWIST,), twist_topic, "-r twist:=TOPIC")
        poses = Trajectory(*_recorded(bag, pose_topic, "pose.position", "pose.orientation"))
        if twist_topic is None:
            return Motions(poses, None)
        return Motions(poses, Twists(*_recorded(bag, twist_topic, "twist.angular", "twist.linear")))


def _recorded(
    bag: BagReader, topic: str, first: str, second: str
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the stamps of a topic, in order and each once, and two parts of its messages."""
    messages = {stamp_ns(message): message for _, _, message in bag.messages([topic])}
    stamps = sorted(messages)
    ones, others = (
        np.array([_numbers(attrgetter(part)(messages[stamp])) for stamp in stamps])
        for part in (first, second)
    )
    return np.array(stamps, np.int64), ones, others


def _numbers(vector: Any) -> list[float]:
    """Return the numbers of a vector or a quaternion."""
    return [float(getattr(vector, axis)) for axis in "xyzw" if hasattr(vector, axis)]
