"""What replay says at its end: how many frames have a pose, how good they are, why others not."""

from __future__ import annotations

import textwrap
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from rs_localizer.cli.replay_result import BRIDGED
from rs_localizer.config import NodeConfig
from rs_localizer.io.image_clock import readout_fault
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.fleet.task import Figures
from rs_localizer.offline.smoothed import SmoothedFrames
from rs_localizer.pipeline.imu import ImuState
from rs_localizer.pipeline.reasons import explained
from rs_localizer.solvers.table import find_solver

# Notices of a frame that could not follow the one before.
_RESTARTS = ("time_went_back", "map_changed")
_WIDTH = 96


@dataclass(slots=True)
class Tally:
    """What became of the frames of a recording."""

    total: int
    notices: Counter[str]
    frames: list[Localized] = field(default_factory=list)
    refused: Counter[str] = field(default_factory=Counter)
    last_refusal: str = "nothing came"
    not_sent: int = 0
    repeated: int = 0
    seconds: float = 0.0
    smoothed: SmoothedFrames | None = None
    imu: ImuState | None = None

    @property
    def written(self) -> list[Localized]:
        """What the result holds: the frames, or samples of one motion through all of them."""
        return self.smoothed.frames if self.smoothed else self.frames


def figures(tally: Tally) -> Figures:
    """What the summary of many recordings says of this one."""
    estimates = [frame.estimate for frame in tally.frames]
    return {
        "frames": tally.total,
        "localized": len(estimates),
        "residual (px)": float(np.median([estimate.residual_rms for estimate in estimates])),
        "inliers": float(np.median([np.count_nonzero(it.inliers) for it in estimates])),
        "with twist": sum(frame.twist is not None for frame in tally.frames),
        "mostly refused for": next((reason for reason, _ in tally.refused.most_common(1)), ""),
    }


def print_summary(tally: Tally, config: NodeConfig, timed: bool = True) -> None:
    """Print it as a table, the reasons of refusals explained below.

    Args:
        tally: what became of the frames.
        config: the settings.
        timed: whether to say how fast, which is never the same twice.
    """
    frames = tally.frames
    rows: list[tuple[str, str]] = [("frames", str(tally.total)), ("localized", str(len(frames)))]
    rows += [(f"  refused: {reason}", str(n)) for reason, n in tally.refused.most_common()]
    for name, count in tally.notices.most_common():
        kind = "started afresh" if name in _RESTARTS else "noticed"
        rows.append((f"{kind}: {name}", str(count)))
    dropped = sum(frame.dropped for frame in frames)
    for name, count in (
        ("rows dropped (not finite)", dropped),
        ("stamps repeated, not in the text files", tally.repeated),
        ("without a transform on /tf", tally.not_sent),
    ):
        rows += [(name, str(count))] if count else []
    rows += _quality(frames, config) + _inertial(tally.imu)
    if timed:
        rows.append(("frames per second", f"{tally.total / tally.seconds:.0f}"))
    if tally.smoothed:
        rows += _smoothing(tally.smoothed)
    for name, text in rows:
        print(f"{name:40} {text:>8}")
    for reason in (*tally.refused, *(tally.imu.reasons if tally.imu else ())):
        if text := explained(reason):
            print(textwrap.fill(f"{reason}: {text}", _WIDTH, subsequent_indent="    "))
    fault = readout_fault(config.readout_time, _period(frames))
    if fault is not None:
        print(f"warning: {fault}")


def _inertial(imu: ImuState | None) -> list[tuple[str, str]]:
    if imu is None:
        return []
    rows = [("localized with the IMU", f"{imu.used / imu.frames:.1%}")]
    rows += [(f"  without: {reason}", str(count)) for reason, count in imu.reasons.items()]
    if imu.used and imu.status is not None and np.isfinite(imu.time_offset):
        bias, offset = np.degrees(imu.status.bias), 1e3 * imu.time_offset
        rows += [
            ("  bias of the gyroscope (deg/s)", f"{np.linalg.norm(bias):.2f}"),
            ("  time offset of the IMU (ms)", f"{offset:.2f}"),
        ]
    return rows


def _smoothing(smoothed: SmoothedFrames) -> list[tuple[str, str]]:
    return [
        ("samples of the smoothed motion", str(len(smoothed.frames))),
        (f"  bridged, listed in {BRIDGED}", str(len(smoothed.bridged))),
        ("  left out, not determined", str(smoothed.undetermined)),
        ("  shaken faster than it follows, left as they were", str(smoothed.shaken)),
    ]


def _quality(frames: Sequence[Localized], config: NodeConfig) -> list[tuple[str, str]]:
    if not frames:
        return []
    estimates = [frame.estimate for frame in frames]
    residual = np.median([estimate.residual_rms for estimate in estimates])
    model_error = np.median([estimate.model_error for estimate in estimates])
    inliers = np.median([np.count_nonzero(estimate.inliers) for estimate in estimates])
    still = np.median([estimate.global_shutter_inliers for estimate in estimates])
    points = np.median([len(estimate.inliers) for estimate in estimates])
    tracked = np.mean([estimate.tracked for estimate in estimates])
    rows = [
        ("residual of the inliers (px rms, median)", f"{residual:.3f}"),
        ("error of map and lens (px rms, median)", f"{model_error:.3f}"),
        ("points of a frame (median)", f"{points:.0f}"),
    ]
    if find_solver(config.solver).rolling_shutter:
        rows += [
            ("  inliers with a rolling shutter", f"{inliers:.0f}"),
            ("  inliers with a global shutter", f"{still:.0f}"),
            ("tracked from the frame before", f"{tracked:.1%}"),
        ]
    else:
        rows.append(("  inliers", f"{inliers:.0f}"))
    return rows


def _period(frames: Sequence[Localized]) -> float:
    """Seconds from frame to frame, median; NaN for less than two."""
    stamps = np.unique(np.array([frame.input_stamp_ns for frame in frames], np.int64))
    if len(stamps) < 2:
        return np.nan
    steps = np.diff(stamps) * 1e-9
    # Between those with a pose others may have been refused.
    return float(np.median(steps / np.round(steps / steps.min())))
