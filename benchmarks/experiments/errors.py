# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How far estimated motions are from the true ones."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.experiments.trials import Motions
from rs_localizer.core.arrays import Array


@dataclass(frozen=True, slots=True)
class Metric:
    """One of the four errors of the paper's figures."""

    name: str
    label: str


METRICS = (
    Metric("orientation_deg", "orientation error (deg)"),
    Metric("position", "position error / distance"),
    Metric("w_deg", "error of w (deg per frame)"),
    Metric("t", "error of t (per frame)"),
)
ORIENTATION, POSITION, W, T = range(4)


def angles(rotations: Array, others: Array) -> Array:
    """Angles in degrees between rotations (...,3,3); accurate near zero, NaN for NaN."""
    apart = np.linalg.norm(rotations - others, axis=(-2, -1))
    between: Array = np.degrees(2.0 * np.arcsin(np.minimum(apart / np.sqrt(8.0), 1.0)))
    return between


def motion_errors(found: Motions, truth: Motions) -> Array:
    """Errors (h,4) in the order of METRICS; infinite where nothing was found.

    The position's is relative to the camera's distance from the centre of the points.
    """
    distance = np.linalg.norm(truth.position, axis=1)
    errors = np.stack(
        [
            angles(found.rotation, truth.rotation),
            np.linalg.norm(found.position - truth.position, axis=1) / distance,
            np.degrees(np.linalg.norm(found.w - truth.w, axis=1)),
            np.linalg.norm(found.t - truth.t, axis=1),
        ],
        axis=1,
    )
    return np.where(np.isnan(errors), np.inf, errors)
