# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``replay --smooth``: the frames of a recording, and one motion through all of them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from rs_localizer.config import PoseTime
from rs_localizer.core.arrays import IntArray
from rs_localizer.core.rig import Rig, RigEstimate
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.replay import inlier_columns
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import pose_at, published_moment, twist_at
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.pipeline.rig_frames import RigFrames
from rs_localizer.tools.adjust.observe import ImagePoints
from rs_localizer.tools.smoothing import PosedFrame, Smoothed, smooth


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedFrames:
    """Frames of a recording by all its images."""

    frames: list[Localized]
    bridged: IntArray  # (b,) ns, stamps of those without an image of their own
    undetermined: int  # moments that neighbours do not determine
    shaken: int  # images that no smooth motion follows, as they shake: they keep their own poses


def smooth_frames(
    localizer: FrameLocalizer,
    localized: Iterable[Localized],
    stamps_ns: list[int],
    rate: float | None,
) -> SmoothedFrames:
    """Return the frames of a recording again, with their common motion.

    Args:
        localizer: with the settings and the camera that localize them.
        localized: the frames with a pose; of a repeated stamp the last one counts.
        stamps_ns: of all images.
        rate: Hz, samples of the motion; None: one for each image, at ``pose_time``.

    Raises:
        ValueError: when the frames are no single recording of one map, or too few.
    """
    once = {frame.input_stamp_ns: frame for frame in localized}
    frames = [once[stamp] for stamp in sorted(once)]
    if not frames:
        return SmoothedFrames([], np.zeros(0, np.int64), len(set(stamps_ns)), 0)
    if len(maps := {frame.map_frame for frame in frames}) > 1:
        raise ValueError(f"points lie in several frames: {', '.join(sorted(maps))}")
    inputs = np.union1d(stamps_ns, list(once))
    if rate is not None:
        first_ns = min(stamps_ns)
        count = int((max(stamps_ns) + 1 - first_ns) * 1e-9 * rate) + 1
        inputs = first_ns + np.round(np.arange(count) * 1e9 / rate).astype(np.int64)
        inputs, once = inputs[inputs <= max(stamps_ns)], {}
    motion, moments = _motion(localizer, frames, inputs)
    sampled = motion.sample(moments)
    own_poses = {f.input_stamp_ns for f, of in zip(frames, motion.shaken, strict=True) if of}
    result, kept, shaken = [], np.zeros(len(moments), dtype=np.bool_), 0
    for k, estimate in enumerate(sampled.estimates):
        stamp = int(inputs[k])
        own = once.get(stamp)
        if own is not None and (stamp in own_poses or not sampled.determined[k]):
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
                body_frame=localizer.camera_frame,
                pose=pose_at(estimate, 0.0),
                twist=twist_at(estimate, 0.0, motion.readout_time),
                inliers=frames[0].inliers[:0] if own is None else own.inliers,
                dropped=0 if own is None else own.dropped,
                estimate=estimate,
                cameras=() if own is None else own.cameras,
            )
        )
        if not isinstance(frame, Refusal):
            result.append(frame)
            kept[k] = True
    without = sampled.bridged if rate is not None else ~np.isin(inputs, list(once))
    undetermined = int(np.count_nonzero(~kept))
    return SmoothedFrames(result, moments[kept & without], undetermined, shaken)


def _motion(
    localizer: FrameLocalizer, frames: list[Localized], inputs: IntArray
) -> tuple[Smoothed, IntArray]:
    """Return the motion through frames, and the moments (m,) ns published of inputs (m,)."""
    config, calibration = localizer.config, localizer.calibration
    if isinstance(localizer, RigFrames):
        rig, posed = localizer.rig, [_rig_frame(frame) for frame in frames]
        if config.pose_time != PoseTime.MID_FRAME:
            return smooth(rig, posed), inputs
        pairs = zip(frames, posed, strict=True)
        delays = {f.input_stamp_ns: r.time_ns - f.input_stamp_ns for f, r in pairs}
        usual = round(float(np.median(list(delays.values()))))
        moments = inputs + np.array([delays.get(stamp, usual) for stamp in inputs.tolist()])
        return smooth(rig, posed), moments
    assert calibration is not None
    camera = calibration.camera(config.readout_time, config.scan_direction)
    rig, offset_ns = Rig.of(camera), round(1e9 * config.stamp_offset)
    delay_ns = round(-1e9 * camera.readout_time * camera.first_row_time)
    (name,), posed = rig.cameras, []
    for frame in frames:
        start_ns = frame.input_stamp_ns + offset_ns
        points, pixels = (inlier_columns(frame, names) for names in ("xyz", "uv"))
        image = ImagePoints(start_ns, points, pixels)
        posed.append(PosedFrame(start_ns + delay_ns, {name: image}, frame.estimate))
    return smooth(rig, posed), inputs + published_moment(config, camera, 0)[0]


def _rig_frame(frame: Localized) -> PosedFrame:
    assert isinstance(frame.estimate, RigEstimate)
    counts = np.cumsum([share.inliers for share in frame.cameras])[:-1]
    points, pixels = (np.split(inlier_columns(frame, names), counts) for names in ("xyz", "uv"))
    images = {
        share.name: ImagePoints(share.start_ns, *own)
        for share, *own in zip(frame.cameras, points, pixels, strict=True)
    }
    # Times of a rig's estimate count from its first image.
    time_ns = frame.cameras[0].start_ns + round(1e9 * frame.estimate.time)
    return PosedFrame(time_ns, images, frame.estimate)
