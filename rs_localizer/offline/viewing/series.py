"""What changes from frame to frame, as columns for plots."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.viewing import paths

Series = dict[str, tuple[list[str], Array]]
_AXES = ["x", "y", "z"]
_UNKNOWN = np.full(3, np.nan)


def series(frames: Sequence[Localized]) -> Series:
    """By path: the names of k curves, and their values (n,k), NaN where there is none."""
    found = [frame.estimate for frame in frames]
    spread = [np.sqrt(np.diag(frame.pose.covariance)) for frame in frames]
    twists = [frame.twist for frame in frames]
    return {
        paths.ANGULAR: (_AXES, _rows([t.angular if t else _UNKNOWN for t in twists])),
        paths.LINEAR: (_AXES, _rows([t.linear if t else _UNKNOWN for t in twists])),
        paths.RESIDUAL: (
            ["residual of the inliers", "model error"],
            _rows([[_rms(frame), frame.estimate.model_error] for frame in frames]),
        ),
        paths.COUNTS: (
            ["points", "inliers, rolling shutter", "inliers, global shutter"],
            _rows([[len(e.inliers), e.inliers.sum(), e.global_shutter_inliers] for e in found]),
        ),
        paths.DEVIATION: (
            ["position", "orientation"],
            1e3 * _rows([[np.linalg.norm(s[:3]), np.linalg.norm(s[3:])] for s in spread]),
        ),
    }


def _rms(frame: Localized) -> float:
    """NaN for a sample of a smoothed motion between images."""
    return frame.estimate.residual_rms if np.any(frame.estimate.inliers) else np.nan


def _rows(values: Sequence[Any]) -> Array:
    return np.array(values, dtype=np.float64)
