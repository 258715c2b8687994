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

# Recordings are smoothed in windows of so many seconds and so much on both sides of them: what an
# image farther away says is forgotten, since accelerations fade within 0.1 s.
_WINDOW_NS, _MARGIN_NS = 60_000_000_000, 2_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedFrames:
    """What the whole recording says of each moment."""

    frames: list[Localized]
    bridged: IntArray  # (b,) ns, stamps of those without an image of their own
    undetermined: int  # moments that neighbours do not determine
    shaken: int  # images that shake faster than a smooth motion, and keep their own poses


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
    if localizer.calibration is None or not localized:
        raise ValueError("no image has a pose: there is nothing to smooth")
    maps = {frame.map_frame for frame in localized}
    if len(maps) > 1:
        raise ValueError(f"points lie in several frames: {', '.join(sorted(maps))}")
    once = {frame.input_stamp_ns: frame for frame in localized}
    stamps = np.array(sorted(once), dtype=np.int64)
    inputs = np.array(sorted(set(stamps_ns)), dtype=np.int64)
    if rate is not None:
        count = int((stamps[-1] - stamps[0]) * 1e-9 * rate) + 1
        inputs = stamps[0] + np.round(np.arange(count) * 1e9 / rate).astype(np.int64)
    # The last window takes a rest that would be short.
    windows = max(int((stamps[-1] - stamps[0]) // _WINDOW_NS), 1)
    edges = stamps[0] + _WINDOW_NS * np.arange(1, windows)
    result, bridged, undetermined, shaken = [], [], 0, 0
    for k, wanted in enumerate(np.split(inputs, np.searchsorted(inputs, edges))):
        first = 0 if k == 0 else np.searchsorted(stamps, edges[k - 1] - _MARGIN_NS)
        last = len(stamps) if k == windows - 1 else np.searchsorted(stamps, edges[k] + _MARGIN_NS)
        near = [once[int(stamp)] for stamp in stamps[first:last]]
        part = _smoothed(localizer, near, wanted, rate is not None)
        result += part.frames
        bridged.append(part.bridged)
        undetermined += part.undetermined
        shaken += part.shaken
    return SmoothedFrames(result, np.concatenate(bridged), undetermined, shaken)


def _smoothed(
    localizer: FrameLocalizer, frames: list[Localized], inputs: IntArray, sampled_evenly: bool
) -> SmoothedFrames:
    """Frames at the stamps ``inputs`` (m,) by the motion through ``frames``."""
    config, calibration = localizer.config, localizer.calibration
    assert calibration is not None
    camera = calibration.camera(config.readout_time, config.scan_direction)
    images = [
        Observed(frame.input_stamp_ns, _columns(frame, "xyz"), _columns(frame, "uv"))
        for frame in frames
    ]
    motion = smooth(camera, images, [frame.estimate for frame in frames], config.stamp_offset)
    delay, _ = published_moment(config, camera, 0)
    moments = inputs + delay
    sampled = motion.sample(moments)
    once = {} if sampled_evenly else {frame.input_stamp_ns: frame for frame in frames}
    own_poses = {
        frame.input_stamp_ns
        for frame, shaken in zip(frames, motion.shaken, strict=True)
        if shaken and not sampled_evenly
    }
    nothing = frames[0].inliers[:0]
    result, kept, shaken = [], np.zeros(len(moments), dtype=np.bool_), 0
    for k, estimate in enumerate(sampled.estimates):
        stamp = int(inputs[k])
        own = once.get(stamp)
        if own is not None and stamp in own_poses:
            result.append(own)
            kept[k], shaken = True, shaken + 1
            continue
        if not sampled.determined[k]:
            continue
        frame = localizer.mounted(
            Localized(
                input_stamp_ns=stamp,
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
    without = sampled.bridged if sampled_evenly else ~np.isin(inputs, list(once))
    undetermined = int(np.count_nonzero(~kept))
    return SmoothedFrames(result, moments[kept & without], undetermined, shaken)


def _columns(frame: Localized, names: str) -> NDArray[np.float64]:
    return np.stack([frame.inliers[name].astype(np.float64) for name in names], axis=1)
