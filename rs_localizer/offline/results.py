# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Results of a recording: poses, twists, messages, and their summary.

Frames are written as they come; of each, some numbers stay (250 bytes).
"""

from __future__ import annotations

import textwrap
import time
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rs_localizer.config import NodeConfig, PoseTime
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Reason
from rs_localizer.io.bags import BagReader, BagWriter
from rs_localizer.io.image_clock import readout_fault
from rs_localizer.io.messages import stamp_ns
from rs_localizer.io.outputs import Localized, messages
from rs_localizer.io.recording import BRIDGED, RESULT
from rs_localizer.io.topics import TF
from rs_localizer.io.trajectories import (
    POSES_FILE,
    TWISTS_FILE,
    Motions,
    Trajectory,
    Twists,
    format_stamp,
    write_tum,
    write_twists,
)
from rs_localizer.io.transforms import TransformError, make_transform
from rs_localizer.offline.frame_table import FrameTable
from rs_localizer.offline.replay import NO_FRAMES, TF_TYPE, Answer, Topics, replay
from rs_localizer.offline.tasks import Figures
from rs_localizer.pipeline.aid import AidInput
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.map_to_odom import CorrectionState
from rs_localizer.pipeline.published import broadcast
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.settings import NODE_NAME
from rs_localizer.solvers.table import find_solver

_UNKNOWN_TWIST = (np.nan,) * 6


class Track:
    """Poses and twists by their stamps."""

    def __init__(self) -> None:
        self._stamps_ns, self._rows = array("q"), array("d")
        self._bodies: set[str] = set()
        self._maps: set[str] = set()

    def add(self, frame: Localized) -> None:
        twist = frame.known_twist
        rotation = np.ascontiguousarray(frame.pose.rotation)
        self._stamps_ns.append(frame.stamp_ns)
        self._rows.extend(frame.pose.position)
        self._rows.extend(so3.quaternion(rotation))
        self._rows.extend(_UNKNOWN_TWIST if twist is None else (*twist.angular, *twist.linear))
        self._bodies.add(repr(frame.body_frame))
        self._maps.add(repr(frame.map_frame))

    def motions(self) -> Motions:
        """Return the motions in the order of their stamps, the first of each."""
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
    writer: BagWriter, frame: Localized, localizer: FrameLocalizer, recorded_ns: int, tally: Tally
) -> None:
    """Write all messages of a frame; count it if its transform cannot be told."""
    for name, message in messages(frame, writer.make).items():
        writer.write(f"/{NODE_NAME}/{name}", message, recorded_ns)
    try:
        item, tally.correction = broadcast(
            frame, localizer.config, localizer.transforms, tally.correction
        )
    except TransformError:
        tally.not_sent += 1
        return
    if item is not None:
        transform = make_transform(
            writer.make, item.stamp_ns, item.parent, item.child, item.parent_from_child
        )
        writer.write(TF, writer.make(TF_TYPE, transforms=[transform]), recorded_ns)


# Numbers of each frame with a pose.
_COLUMNS = (*("residual", "model_error", "inliers", "points", "tracked", "dropped", "twist"),)


@dataclass(slots=True)
class Tally:
    """Counts of what became of the frames of a recording."""

    total: int
    notices: dict[str, tuple[int, str]]  # by name: how often, and the latest sentence
    table: FrameTable | None = None  # of the frames, where one is wanted
    done: Callable[[], object] = lambda: None  # called after each frame
    track: Track = field(default_factory=Track)
    correction: CorrectionState = field(default_factory=CorrectionState)  # of map -> odom
    refused: Counter[Reason] = field(default_factory=Counter)
    details: dict[Reason, str] = field(default_factory=dict)  # the latest of each
    last_refusal: str = "nothing came"
    not_sent: int = 0
    repeated: int = 0
    seconds: float = 0.0
    moving: bool = False  # whether there are twists
    smoothed: Any = None  # what became of the moments of one that was smoothed
    aid: AidInput | None = None
    readout: tuple[float, float] | None = None  # s, as the motion shows it, and its deviation
    _stamps_ns: array[int] = field(default_factory=lambda: array("q"))  # of the images
    _numbers: array[float] = field(default_factory=lambda: array("d"))

    def add(self, frame: Localized) -> None:
        """Count a frame with a pose."""
        estimate = frame.estimate
        self._stamps_ns.append(frame.input_stamp_ns)
        self._numbers.extend((
            estimate.residual_rms, estimate.model_error, int(np.count_nonzero(estimate.inliers)),
            len(estimate.inliers), estimate.tracked, frame.dropped, frame.known_twist is not None,
        ))  # fmt: skip

    def refuse(self, refusal: Refusal) -> None:
        """Count a message without one."""
        self.refused[refusal.reason] += 1
        self.details[refusal.reason] = refusal.detail
        self.last_refusal = f"{refusal.reason}: {refusal.detail}"

    def finish(self, localizer: FrameLocalizer) -> None:
        """Take what the localizer knows at the end."""
        if localizer.config.of_cameras:
            # Images of several cameras are one frame.
            lost = sum(n for reason, n in self.refused.items() if reason not in NO_FRAMES)
            self.total = self.localized + lost
        self.aid = localizer.aid
        if (measured := localizer.tracker.shutter.measured) is not None:
            self.readout = measured.readout_time, measured.deviation

    @property
    def localized(self) -> int:
        """Number of frames with a pose."""
        return len(self._stamps_ns)

    def column(self, name: str) -> Array:
        """Return a number of each of these frames (n,), one of :data:`_COLUMNS`."""
        table = np.array(self._numbers).reshape(-1, len(_COLUMNS))
        return table[:, _COLUMNS.index(name)].copy()

    @property
    def period(self) -> float:
        """Seconds from frame to frame, median; NaN for less than two."""
        steps = np.diff(np.unique(np.array(self._stamps_ns, np.int64))) * 1e-9
        # Between those with a pose others may have been refused.
        return float(np.median(steps / np.round(steps / steps.min()))) if len(steps) else np.nan


Smooth = Callable[[Iterator[Localized], list[int]], Any]
"""One motion through frames: of frames, and the stamps (ns) of all images; as ``tools.smoothed``
makes it."""


def write_results(
    bag: BagReader, topics: Topics, localizer: FrameLocalizer, tally: Tally, out: Path,
    smooth: Smooth | None = None,
) -> None:  # fmt: skip
    """Replay a recording into a folder, and count what became of its frames.

    Args:
        bag: the recording, of these topics.
        localizer: of its frames.
        tally: with a table where one is wanted.
        out: has the poses, the twists, and the bag of the node's messages then.
        smooth: makes one motion of the frames.
    """
    refused: list[Answer] = []
    smoothed: set[int] = set()  # stamps of images
    start = time.perf_counter()

    def localized() -> Iterator[tuple[int, Localized]]:
        """Yield frames with a pose and their times of recording; count and keep the others."""
        for answer in replay(bag, topics, localizer):
            result = answer.result
            if result:
                tally.add(result)
                yield answer.recorded_ns, result
            else:
                tally.refuse(result)
                if result.reason in NO_FRAMES:
                    continue
                if tally.table is not None:
                    refused.append(answer)
            tally.done()

    with BagWriter(out / RESULT) as writer:
        frames: Iterable[tuple[int, Localized]] = localized()
        if smooth is not None:
            stamps = [stamp_ns(message) for _, _, message in bag.messages([topics.frames])]
            tally.smoothed = smooth((frame for _, frame in localized()), stamps)
            frames = ((frame.input_stamp_ns, frame) for frame in tally.smoothed.frames)
        for recorded_ns, frame in frames:
            write_frame(writer, frame, localizer, recorded_ns, tally)
            tally.track.add(frame)
            if tally.table is not None:
                tally.table.add(frame.input_stamp_ns, frame)
                if smooth is not None:
                    smoothed.add(frame.input_stamp_ns)
    if tally.smoothed is not None:
        stamps = tally.smoothed.bridged.tolist()
        text = "".join(f"{format_stamp(stamp)}\n" for stamp in stamps)
        (out / BRIDGED).write_text(text, encoding="utf-8")
    if tally.table is not None:
        for answer in refused:
            if answer.stamp_ns not in smoothed:
                tally.table.add(answer.stamp_ns, answer.result)
    tally.seconds = time.perf_counter() - start
    tally.finish(localizer)
    tally.repeated, tally.moving = tally.track.write(out, localizer.config.pose_time)


# Notices of a frame that could not follow the one before.
_RESTARTS = ("time_went_back", "map_changed")
_WIDTH = 96  # columns of a terminal that is not narrow


def summary(tally: Tally, config: NodeConfig, out: Path, timed: bool = True) -> list[str]:
    """Return the lines of a table, with the reasons of refusals explained below.

    Args:
        out: where the results are.
        timed: whether to say how fast, which is never the same twice.
    """
    rows: list[tuple[str, object]] = [("frames", tally.total), ("localized", tally.localized)]
    rows += [(f"  refused: {reason}", n) for reason, n in tally.refused.most_common()]
    for name, (count, _) in sorted(tally.notices.items(), key=lambda item: -item[1][0]):
        rows.append((f"{'restarted' if name in _RESTARTS else 'noticed'}: {name}", count))
    for name, count in (
        ("rows dropped (not finite)", int(tally.column("dropped").sum())),
        ("stamps repeated, not in the text files", tally.repeated),
        ("without a transform on /tf", tally.not_sent),
    ):
        rows += [(name, count)] if count else []
    if tally.localized:
        rolling = find_solver(config.solver).rolling_shutter
        rows += [
            (name, f"{np.median(tally.column(column)):{form}}")
            for name, column, form in (
                ("residual of the inliers (px rms, median)", "residual", ".3f"),
                ("error of map and lens (px rms, median)", "model_error", ".3f"),
                ("points of a frame (median)", "points", ".0f"),
                ("  inliers", "inliers", ".0f"),
            )
        ]
        if rolling:
            rows.append(("tracked from the frame before", f"{tally.column('tracked').mean():.1%}"))
    if tally.aid is not None:
        rows += tally.aid.values().items()
    if timed:
        rows.append(("frames per second", f"{tally.total / tally.seconds:.0f}"))
    if (smoothed := tally.smoothed) is not None:
        rows += [
            ("samples of the smoothed motion", len(smoothed.frames)),
            (f"  bridged, listed in {BRIDGED}", len(smoothed.bridged)),
            ("  left out, not determined", smoothed.undetermined),
            ("  vibrating, left as they were", smoothed.shaken),
        ]
    lines = [f"{name:40} {text!s:>8}" for name, text in rows]
    said = [*tally.details.items(), *(() if tally.aid is None else tally.aid.details.items())]
    noticed = [(name, text) for name, (_, text) in tally.notices.items()]
    for name, text in dict[str, str]([*said, *noticed]).items():
        lines += textwrap.wrap(f"{name}: {text}", _WIDTH, subsequent_indent="    ")
    if (fault := readout_fault(config.readout_time, tally.period)) is not None:
        lines.append(f"warning: {fault}")
    if tally.localized and not tally.moving:
        why = "no frame determines them"
        if not find_solver(config.solver).rolling_shutter:
            why = f"solver {config.solver} estimates no velocities"
        if config.readout_time == 0.0:
            why = "readout_time is 0 (unknown); give it with -p readout_time:=SECONDS"
        lines.append(f"no twists: {why}")
    files = [POSES_FILE, *([TWISTS_FILE] if tally.moving else []), RESULT]
    files += [BRIDGED] if tally.smoothed else []
    return [*lines, f"written to {out}: {', '.join(files)}"]


def figures(tally: Tally) -> Figures:
    """Return the figures of a recording, for the summary of many."""
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
