"""Parts of a recording that are calibrated on their own, and whether they agree."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy.stats import chi2

from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.fit import Fit, fit
from rs_localizer.trajectory.gyro_kernels import DELAY, MOUNT
from rs_localizer.trajectory.model import Observations, State
from rs_localizer.trajectory.start import refined

# Parts of the recording that are calibrated on their own: three at least, for two that agree may do
# so by chance, and more of a longer one.
_BLOCK_SECONDS, _LEAST_BLOCKS, _MOST_BLOCKS = 3.0, 3, 8
# Blocks that would differ this much by chance once in a hundred recordings disagree.
_DISAGREEMENT = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A part of the recording on its own."""

    start: float  # s
    end: float  # s
    readout_time: float  # s
    deviation: float  # s
    camera: Camera  # with the lens of this part
    delay: float = math.nan  # s, of the gyroscope where there is one
    delay_deviation: float = math.nan  # s


def blocks_of(
    camera: Camera, observations: Observations, whole: Fit, count: int | None = None
) -> tuple[Block, ...]:
    """Equal parts of the recording, each with a lens and a shape of the map of its own.

    Args:
        camera: whose lens the whole was started from.
        count: of the parts; None: as many as the recording is long enough for.
    """
    first, last = observations.times.min(), observations.times.max()
    if count is None:
        count = int(np.clip((last - first) / _BLOCK_SECONDS, _LEAST_BLOCKS, _MOST_BLOCKS))
    blocks: list[Block] = []
    for start, end in pairwise(np.linspace(first, last + 1e-6, count + 1)):
        # Not only what fits the whole: a part that differs would be left out of its own estimate.
        part = observations.subset((observations.times >= start) & (observations.times < end))
        state = _cut(whole.state, start, end)
        if state is None or not np.any(part.trusted):
            continue
        try:
            own = fit(camera, part, state, whole.freedom)
        except ValueError:  # undetermined, or a lens that no camera has
            continue
        value, deviation = own.state.readout_time, own.readout_time_deviation
        delay = _delay(own)
        blocks.append(Block(float(start), float(end), value, deviation, own.camera, *delay))
    return tuple(blocks)


def _delay(own: Fit) -> tuple[float, float]:
    """Delay of the gyroscope and its deviation, s; NaN without one."""
    if own.state.mount is None:
        return math.nan, math.nan
    at = DELAY - MOUNT
    return own.state.mount.delay, math.sqrt(float(own.border_covariance[at, at]))


def _cut(state: State, start: float, end: float) -> State | None:
    """The state with the motion between two times only."""
    layout = state.spline.layout
    intervals = np.column_stack([layout.starts, layout.ends])
    margin = abs(state.readout_time)
    kept = np.clip(intervals, start - margin, end + margin)
    kept = kept[kept[:, 1] - kept[:, 0] > layout.spacing]
    if len(kept) == 0:
        return None
    return replace(state, spline=refined(state.spline, layout.spacing, kept))


def disagreement(values: Array, deviations: Array) -> float:
    """By how much deviations (b,) are too small for the scatter of values (b,) (Birge's ratio),
    1 if that may be chance.
    """
    if len(values) < 2:
        return 1.0
    weights = deviations**-2.0
    total = float(np.sum(weights))
    mean = np.sum(weights * values) / total
    squared = float(np.sum(weights * (values - mean) ** 2))
    freedoms = len(values) - 1
    if chi2.sf(squared, freedoms) > _DISAGREEMENT:
        return 1.0
    # What the blocks disagree in is not their noise: none of them is better than the others.
    scatter = np.std(values, ddof=1) / math.sqrt(len(values))
    return max(math.sqrt(squared / freedoms), float(scatter) * math.sqrt(total))


def excess(values: Array, deviations: Array) -> float:
    """By how much the deviation of the weighted mean of values (b,) is too small, as they scatter
    more than by their deviations (b,); 1 if that may be chance.

    Blocks may be known very differently well; all are taken to differ by the same on top
    (DerSimonian and Laird, Meta-analysis in clinical trials, Controlled Clinical Trials 1986).
    """
    weights = deviations**-2.0
    total, squares = float(np.sum(weights)), float(np.sum(weights**2))
    mean = np.sum(weights * values) / total
    squared, freedoms = float(np.sum(weights * (values - mean) ** 2)), len(values) - 1
    if freedoms < 1 or chi2.sf(squared, freedoms) > _DISAGREEMENT:
        return 1.0
    own = max(squared - freedoms, 0.0) / (total - squares / total)
    return math.sqrt(1.0 + own * squares / total)
