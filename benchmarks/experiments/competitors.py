# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What else there is to find a pose: OpenCV's and, where it is installed, PoseLib's."""

from __future__ import annotations

import importlib
from types import ModuleType

import cv2
import numpy as np

from benchmarks.experiments.stopwatch import Subject
from benchmarks.experiments.trials import Trials, camera


def poselib() -> ModuleType | None:
    """The module, or None where it is not installed."""
    try:
        return importlib.import_module("poselib")
    except ImportError:
        return None


def p3p_subjects(trials: Trials) -> dict[str, Subject]:
    """P3P on the first three points of each frame, one call per frame."""
    K = camera().K
    triplets = [np.ascontiguousarray(x[:3]) for x in trials.points]
    pixels = [np.ascontiguousarray(r[:3] * K[0, 0] + K[:2, 2]) for r in trials.rays]

    def opencv() -> None:
        for points, seen in zip(triplets, pixels, strict=True):
            cv2.solveP3P(points, seen, K, None, cv2.SOLVEPNP_P3P)

    subjects = {"OpenCV solveP3P": Subject(opencv, len(trials))}
    module = poselib()
    if module is not None:
        bearings = []
        for rays in trials.rays[:, :3]:
            bearing = np.column_stack([rays, np.ones(3)])
            bearings.append(list(bearing / np.linalg.norm(bearing, axis=1, keepdims=True)))
        lists = [list(points) for points in triplets]

        def with_poselib() -> None:
            for bearing, points in zip(bearings, lists, strict=True):
                module.p3p(bearing, points)

        subjects["PoseLib p3p"] = Subject(with_poselib, len(trials))
    return subjects
