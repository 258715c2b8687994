# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A real global shutter before real tags: a rolling-shutter estimator must find no motion there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.data import GLOBAL_SHUTTER_TAGS
from benchmarks.experiments.uncertainty import IntArray, Interval, bootstrap
from benchmarks.frames.judged import REGION
from benchmarks.honesty.scores import motion_evidence, percent
from benchmarks.independent.rotations import logarithm
from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.outputs import Localized
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import twist_at
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.solvers.table import find_solver

CAMERA_INFO, CORRESPONDENCES = "/camera/camera_info", "/camera/correspondences"
FRAMES = 450
_BLOCK_NS = 1_000_000_000  # frames of one second are not independent


@dataclass(frozen=True, slots=True)
class Condition:
    """How the recording is replayed: what differs from the node's defaults."""

    name: str
    config: NodeConfig


@dataclass(frozen=True, slots=True, eq=False)
class Replayed:
    """What came of it."""

    frames: int
    localized: int
    jitter: Array  # (n,) deg, second differences of the orientation
    seconds: IntArray  # (n,) of the recording, in which each was
    # (m,) whether the 95 % region of the velocities contains zero; without any, where none are.
    insignificant: BoolArray
    reasons: str

    def interval(self, quantile: float) -> Interval:
        """Of the jitter."""

        def of(chosen: IntArray) -> float:
            return float(np.quantile(self.jitter[chosen], quantile))

        return bootstrap(of, len(self.jitter), self.seconds)


def conditions() -> Sequence[Condition]:
    return [
        Condition("p3p", NodeConfig(solver="p3p")),
        Condition("default", NodeConfig()),
        Condition("20 ms, tracked", NodeConfig(readout_time=0.02)),
        Condition("20 ms, single", NodeConfig(readout_time=0.02, tracking=False)),
    ]


def measure(condition: Condition, frames: int = FRAMES) -> Replayed:
    """Replay the first frames of the recording as the node would see them."""
    localizer = FrameLocalizer(condition.config)
    results: list[Localized | Refusal] = []
    with open_bag(GLOBAL_SHUTTER_TAGS) as bag:
        for topic, _, message in bag.messages((CAMERA_INFO, CORRESPONDENCES)):
            if topic == CAMERA_INFO:
                localizer.calibrate(read_camera_info(message))
            elif len(results) < frames:
                results.append(localizer.localize(message))
    found = [result for result in results if isinstance(result, Localized)]
    reasons = Counter(result.reason for result in results if isinstance(result, Refusal))
    moving = []
    if find_solver(condition.config.solver).rolling_shutter:
        # Per readout: a readout time is not always set.
        moving = [motion_evidence(twist_at(frame.estimate, 0.0, 1.0)) < REGION for frame in found]
    jitter, seconds = _second_differences(found)
    return Replayed(
        len(results),
        len(found),
        jitter,
        seconds,
        np.array(moving, dtype=np.bool_),
        ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()),
    )


def _second_differences(frames: Iterable[Localized]) -> tuple[Array, IntArray]:
    """Angles (n,) in deg between a turn and the next one, and the second of each."""
    turns = [
        (after.input_stamp_ns, logarithm(before.pose.rotation.T @ after.pose.rotation))
        for before, after in pairwise(frames)
    ]
    jitter, seconds = [], []
    for (_, first), (stamp_ns, second) in pairwise(turns):
        jitter.append(float(np.degrees(np.linalg.norm(second - first))))
        seconds.append(stamp_ns // _BLOCK_NS)
    return np.array(jitter), np.array(seconds, dtype=np.int64)


COLUMNS = (
    "condition",
    "frames",
    "jitter_deg",
    "jitter_deg_95",
    "insignificant",
    "refused",
    "reasons",
)


def row(name: str, found: Replayed) -> tuple[str | float | int, ...]:
    """Shares in %."""
    return (
        name,
        found.frames,
        *(float(np.quantile(found.jitter, quantile)) for quantile in (0.5, 0.95)),
        percent(found.insignificant),
        100.0 * (1.0 - found.localized / found.frames),
        found.reasons,
    )
