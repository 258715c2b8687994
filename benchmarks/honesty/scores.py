# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Errors of estimates in their own units: what a covariance promises, against the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from benchmarks.frames.judged import of_pose, of_twist
from rs_localizer.core.arrays import Array, BoolArray
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.outputs import Pose, Twist
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at


class Truth(NamedTuple):
    """The camera at one instant."""

    rotation: Array  # (3,3) map_from_camera
    position: Array  # (3,)
    angular: Array  # (3,) rad/s, camera axes
    linear: Array  # (3,) m/s, camera axes


@dataclass(frozen=True, slots=True)
class Score:
    """One frame at one moment: squared normalised errors of 6 dimensions, and plain errors.

    Infinite without a pose; those of the twist are NaN where there is none.
    """

    recording: int
    reason: str = ""  # why there is no pose
    pose: float = np.inf
    twist: float = np.inf
    orientation: float = np.inf  # deg
    position: float = np.inf  # m
    angular: float = np.inf  # deg/s
    linear: float = np.inf  # m/s


def score(pose: Pose, twist: Twist | None, truth: Truth, recording: int = 0) -> Score:
    """What is published, against the truth of that moment."""
    squared, _, _, degrees, millimetres = of_pose(pose, truth)
    found = Score(
        recording, pose=squared, orientation=degrees, position=1e-3 * millimetres,
        twist=np.nan, angular=np.nan, linear=np.nan,
    )  # fmt: skip
    if twist is None:
        return found
    squared, _, _, angular, linear = of_twist(twist, truth)
    return replace(found, twist=squared, angular=angular, linear=linear)


def score_at(
    result: Estimate | Failure, tau: float, readout_time: float, truth: Truth, recording: int
) -> Score:
    """An estimate at row time ``tau``; ``readout_time`` in s, 0: unknown, then no twist."""
    if not result:
        return Score(recording, reason=str(result.reason))
    twist = twist_at(result, tau, readout_time) if readout_time > 0.0 else None
    return score(pose_at(result, tau), twist, truth, recording)


class Scores:
    """Many of them, as columns."""

    def __init__(self, scores: Sequence[Score]) -> None:
        self.scores = scores

    def __len__(self) -> int:
        return len(self.scores)

    def of(self, name: str) -> Array:
        """A column (n,) of figures."""
        return np.array([getattr(one, name) for one in self.scores], dtype=np.float64)

    @property
    def localized(self) -> BoolArray:
        return np.array([one.reason == "" for one in self.scores], dtype=np.bool_)

    def median(self, name: str) -> float:
        """Of the localized frames."""
        known = self.of(name)[self.localized]
        return float(np.median(known)) if len(known) else np.nan
