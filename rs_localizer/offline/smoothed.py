"""``replay --smooth``: the frames of a whole recording, and one motion through all of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import IntArray
from rs_localizer.io.outputs import Localized
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import pose_at, published_moment, twist_at
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.trajectory.observe import Observed
from rs_localizer.trajectory.smoothing import smooth


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedFrames:
    """What the whole recording says of each moment."""

    frames: list[Localized]
    bridged: IntArray  # (b,) ns, stamps of those without an image of their own
    undetermined: int  # moments that neighbours do not determine


def smooth_frames(
    localizer: FrameLocalizer, localized: list[Localized], stamps_ns: list[int], rate: float | None
) -> SmoothedFrames:
    """The frames of a recording again, each with the motion that all of them say.

    Args:
        localizer: with the settings and the camera that localized them.
        localized: the frames with a pose.
        stamps_ns: of all images.
        rate: Hz, samples of the motion; None: one for each image, at ``pose_time``.

    Raises:
        ValueError: when the frames are no single recording of one map, or too few.
    """
    config = localizer.config
    calibration = localizer.calibration
    if calibration is None or not localized:
        raise ValueError("no image has a pose: there is nothing to smooth")
    maps = {frame.map_frame for frame in localized}
    if len(maps) > 1:
        raise ValueError(f"points lie in several frames: {', '.join(sorted(maps))}")
    once = {frame.input_stamp_ns: frame for frame in localized}
    frames = [once[stamp] for stamp in sorted(once)]
    camera = calibration.camera(config.readout_time, config.scan_direction)
    images = [
        Observed(frame.input_stamp_ns, _columns(frame, "xyz"), _columns(frame, "uv"))
        for frame in frames
    ]
    found = smooth(camera, images, [frame.estimate for frame in frames], config.stamp_offset)
    delay, _ = published_moment(config, camera, 0)
    inputs = np.array(sorted(set(stamps_ns)), dtype=np.int64)
    if rate is not None:
        first, last = frames[0].input_stamp_ns, frames[-1].input_stamp_ns
        count = int((last - first) * 1e-9 * rate) + 1
        inputs = first + np.round(np.arange(count) * 1e9 / rate).astype(np.int64)
    moments = inputs + delay
    sampled = found.sample(moments)
    nothing = frames[0].inliers[:0]
    result = []
    kept = np.zeros(len(moments), dtype=np.bool_)
    for k, estimate in enumerate(sampled.estimates):
        if not sampled.determined[k]:
            continue
        own = once.get(int(inputs[k])) if rate is None else None
        frame = localizer.mounted(
            Localized(
                input_stamp_ns=int(inputs[k]),
                stamp_ns=int(moments[k]),
                map_frame=frames[0].map_frame,
                body_frame=calibration.frame,
                pose=pose_at(estimate, 0.0),
                twist=twist_at(estimate, 0.0, config.readout_time),
                inliers=nothing if own is None else own.inliers,
                dropped=0 if own is None else own.dropped,
                estimate=estimate,
            )
        )
        if not isinstance(frame, Refusal):
            result.append(frame)
            kept[k] = True
    bridged = kept & (sampled.bridged if rate is not None else ~np.isin(inputs, list(once)))
    return SmoothedFrames(result, moments[bridged], int(np.count_nonzero(~kept)))


def _columns(frame: Localized, names: str) -> NDArray[np.float64]:
    return np.stack([frame.inliers[name].astype(np.float64) for name in names], axis=1)
