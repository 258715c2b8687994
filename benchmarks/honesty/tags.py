# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A real global shutter before real tags: a rolling-shutter estimator must find no motion there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from benchmarks.data import GLOBAL_SHUTTER_TAGS
from benchmarks.frames.judged import REGION
from benchmarks.honesty.scores import motion_evidence, percent
from benchmarks.independent.rotations import logarithm
from rs_localizer.config import NodeConfig
from rs_localizer.io.bags import open_bag
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.outputs import Localized
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import twist_at
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.solvers.table import find_solver

_INFO, _CLOUD = "/camera/camera_info", "/camera/correspondences"
COLUMNS = (
    "condition", "frames", "jitter_deg", "jitter_deg_95", "insignificant", "refused", "reasons",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Condition:
    """How the recording is replayed: what differs from the node's defaults."""

    name: str
    config: NodeConfig


def conditions() -> Sequence[Condition]:
    return [
        Condition("p3p", NodeConfig(solver="p3p")),
        Condition("default", NodeConfig()),
        Condition("20 ms, tracked", NodeConfig(readout_time=0.02)),
        Condition("20 ms, single", NodeConfig(readout_time=0.02, tracking=False)),
    ]


def row(condition: Condition, frames: int, seed: int) -> tuple[str | float | int, ...]:
    """Second differences of the orientation, and frames whose velocities' 95 % region contains
    zero, in %; always of the whole recording.
    """
    localizer = FrameLocalizer(condition.config)
    results: list[Localized | Refusal] = []
    with open_bag(GLOBAL_SHUTTER_TAGS) as bag:
        for topic, _, message in bag.messages((_INFO, _CLOUD)):
            if topic == _INFO:
                localizer.calibrate(read_camera_info(message))
            else:
                results.append(localizer.localize(message))
    found = [result for result in results if isinstance(result, Localized)]
    reasons = Counter(result.reason for result in results if isinstance(result, Refusal))
    still = []
    if find_solver(condition.config.solver).rolling_shutter:
        # Per readout: a readout time is not always set.
        still = [motion_evidence(twist_at(frame.estimate, 0.0, 1.0)) < REGION for frame in found]
    turns = [
        logarithm(before.pose.rotation.T @ after.pose.rotation) for before, after in pairwise(found)
    ]
    jitter = np.degrees(np.linalg.norm(np.diff(turns, axis=0), axis=1))
    return (
        condition.name,
        len(results),
        *np.quantile(jitter, [0.5, 0.95]).tolist(),
        percent(np.array(still, dtype=np.bool_)),
        100.0 * (1.0 - len(found) / len(results)),
        ", ".join(f"{count} {reason}" for reason, count in reasons.most_common()),
    )
