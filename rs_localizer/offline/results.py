# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results of a recording: poses, twists, messages, and their summary.

Frames are written as they come; of each, some numbers stay (250 bytes).
"""

from __future__ import annotations

from array import array
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.config import PoseTime
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.outputs import Localized, messages
from rs_localizer.io.topics import TF
from rs_localizer.io.trajectories import (
    POSES_FILE,
    TWISTS_FILE,
    Motions,
    Trajectory,
    Twists,
    write_tum,
    write_twists,
)
from rs_localizer.io.transforms import TransformError, make_transform
from rs_localizer.offline.fleet import Figures
from rs_localizer.offline.frame_table import FrameTable
from rs_localizer.offline.replay import TF_TYPE
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.imu_readings import ImuState
from rs_localizer.pipeline.published import broadcast
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.settings import NODE_NAME

_UNKNOWN_TWIST = (np.nan,) * 6


class Track:
    """Poses and twists by their stamps."""

    def __init__(self) -> None:
        self._stamps_ns, self._rows = array("q"), array("d")
        self._bodies: set[str] = set()
        self._maps: set[str] = set()

    def add(self, frame: Localized) -> None:
        twist = frame.twist
        rotation = np.ascontiguousarray(frame.pose.rotation)
        self._stamps_ns.append(frame.stamp_ns)
        self._rows.extend(frame.pose.position)
        self._rows.extend(so3.quaternion(rotation))
        self._rows.extend(_UNKNOWN_TWIST if twist is None else (*twist.angular, *twist.linear))
        self._bodies.add(repr(frame.body_frame))
        self._maps.add(repr(frame.map_frame))

    def motions(self) -> Motions:
        """In the order of their stamps, the first of each; twists where there are any."""
        stamps, first = np.unique(np.array(self._stamps_ns, np.int64), return_index=True)
        rows = np.array(self._rows).reshape(-1, 13)[first]
        poses, moving = Trajectory(stamps, rows[:, :3], rows[:, 3:7]), np.isfinite(rows[:, 7])
        twists = Twists(stamps[moving], rows[moving, 7:10], rows[moving, 10:])
        return Motions(poses, twists if len(twists) else None)

    def write(self, out: Path, pose_time: str) -> tuple[int, bool]:
        """Write poses and twists; how many stamps were repeated, and if there are twists."""
        bodies = " or ".join(sorted(self._bodies)) or "the camera"
        maps = " or ".join(sorted(self._maps)) or "the map"
        when = {
            PoseTime.STAMP.value: "the stamp of the image (pose_time: stamp)",
            PoseTime.MID_FRAME.value: "the exposure of its middle row (pose_time: mid_frame)",
        }[pose_time]
        motions = self.motions()
        write_tum(
            out / POSES_FILE,
            motions.poses,
            [
                f"pose of {bodies} in {maps}, map_from_body; t: s, {when}",
                "x y z: m, its origin; qx qy qz qw: unit quaternion from its axes to the map's",
            ],
        )
        if motions.twists is not None:
            write_twists(
                out / TWISTS_FILE,
                motions.twists,
                [
                    f"velocity of {bodies} with respect to {maps}, in its own axes; t: s, {when}",
                    "wx wy wz: rad/s; vx vy vz: m/s, of its origin",
                ],
            )
        return len(self._stamps_ns) - len(motions.poses), motions.twists is not None


def write_frame(
    writer: BagWriter, frame: Localized, localizer: FrameLocalizer, recorded_ns: int
) -> bool:
    """Write all messages of a frame; whether its transform could be told."""
    for name, message in messages(frame, writer.make).items():
        writer.write(f"/{NODE_NAME}/{name}", message, recorded_ns)
    try:
        item = broadcast(frame, localizer.config, localizer.transforms)
    except TransformError:
        return False
    if item is not None:
        transform = make_transform(
            writer.make, item.stamp_ns, item.parent, item.child, item.parent_from_child
        )
        writer.write(TF, writer.make(TF_TYPE, transforms=[transform]), recorded_ns)
    return True


# Of each frame with a pose.
_COLUMNS = (*("residual", "model_error", "inliers", "points", "tracked", "dropped", "twist"),)


@dataclass(slots=True)
class Tally:
    """Counts of what became of the frames of a recording."""

    total: int
    notices: dict[str, tuple[int, str]]  # by name: how often, and the latest sentence
    table: FrameTable | None = None  # of the frames, where one is wanted
    track: Track = field(default_factory=Track)
    refused: Counter[str] = field(default_factory=Counter)
    last_refusal: str = "nothing came"
    not_sent: int = 0
    repeated: int = 0
    seconds: float = 0.0
    moving: bool = False  # whether there are twists
    smoothed: Counter[str] | None = None  # what became of the moments of one that was smoothed
    bridged: array[int] = field(default_factory=lambda: array("q"))  # ns, without an image
    imu: ImuState | None = None
    readout: tuple[float, float] | None = None  # s, as the motion shows it, and its deviation
    _stamps_ns: array[int] = field(default_factory=lambda: array("q"))  # of the images
    _numbers: array[float] = field(default_factory=lambda: array("d"))

    def add(self, frame: Localized) -> None:
        """Count a frame with a pose."""
        estimate = frame.estimate
        self._stamps_ns.append(frame.input_stamp_ns)
        self._numbers.extend((
            estimate.residual_rms, estimate.model_error, int(np.count_nonzero(estimate.inliers)),
            len(estimate.inliers), estimate.tracked, frame.dropped, frame.twist is not None,
        ))  # fmt: skip

    def smooth(self, part: Any) -> list[Localized]:
        """Count the frames of a window of ``tools.smoothed``, and give them."""
        self.smoothed = Counter() if self.smoothed is None else self.smoothed
        self.smoothed.update(
            samples=len(part.frames), undetermined=part.undetermined, shaken=part.shaken
        )
        self.bridged.extend(part.bridged.tolist())
        return list(part.frames)

    def refuse(self, refusal: Refusal) -> None:
        """Count a message without one."""
        self.refused[refusal.reason] += 1
        self.last_refusal = f"{refusal.reason}: {refusal.detail}"

    @property
    def localized(self) -> int:
        """Number of frames with a pose."""
        return len(self._stamps_ns)

    def column(self, name: str) -> Array:
        """A number of each of these frames (n,), one of :data:`_COLUMNS`."""
        table = np.array(self._numbers).reshape(-1, len(_COLUMNS))
        return table[:, _COLUMNS.index(name)].copy()

    @property
    def period(self) -> float:
        """Seconds from frame to frame, median; NaN for less than two."""
        steps = np.diff(np.unique(np.array(self._stamps_ns, np.int64))) * 1e-9
        # Between those with a pose others may have been refused.
        return float(np.median(steps / np.round(steps / steps.min()))) if len(steps) else np.nan


def figures(tally: Tally) -> Figures:
    """Figures of a recording, for the summary of many."""
    readout_time, deviation = tally.readout or (np.nan, np.nan)
    return {
        "frames": tally.total,
        "localized": tally.localized,
        "residual_px": float(np.median(tally.column("residual"))),
        "inliers": float(np.median(tally.column("inliers"))),
        "with_twist": int(np.count_nonzero(tally.column("twist"))),
        "mostly_refused_for": next((reason for reason, _ in tally.refused.most_common(1)), ""),
        "noticed": ", ".join(f"{name} {count}" for name, (count, _) in tally.notices.items()),
        "readout_time_seen_ms": 1e3 * readout_time,
        "readout_time_seen_deviation_ms": 1e3 * deviation,
    }
