# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``replay --smooth``: the frames of a recording, and one motion through all of them."""

from bisect import bisect_right
from collections import deque
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

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
from rs_localizer.tools.adjust.spline import LEAST_FRAMES, stretches
from rs_localizer.tools.smoothing import PosedFrame, Smoothed, smooth

# Recordings are smoothed in windows of this many seconds and so much on both sides of them: what an
# image farther away says is forgotten, since accelerations fade within 0.1 s. An image of 60 points
# takes 0.18 MB of its window.
_WINDOW_NS, _MARGIN_NS = 20_000_000_000, 2_000_000_000


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedFrames:
    """Frames at the moments of one window, by all its images."""

    frames: list[Localized]
    bridged: IntArray  # (b,) ns, stamps of those without an image of their own
    undetermined: int  # moments that neighbours do not determine
    shaken: int  # images that no smooth motion follows, as they shake: they keep their own poses


class _Window(NamedTuple):
    stamps_ns: IntArray  # (m,) of the images in it, each once
    first_ns: int  # of the images in it and in its margins
    last_ns: int
    last_place: int  # of these images, in the recording


def smooth_frames(
    localizer: FrameLocalizer,
    localized: Iterable[Localized],
    stamps_ns: list[int],
    rate: float | None,
) -> Iterator[SmoothedFrames]:
    """Yield the frames of a recording again, with their common motion, by windows.

    A window is smoothed when the last image of it has come, and forgotten, so that the memory that
    this takes does not grow with the recording.

    Args:
        localizer: with the settings and the camera that localize them.
        localized: the frames with a pose, in the order of the recording.
        stamps_ns: of all images, in the same order.
        rate: Hz, samples of the motion; None: one for each image, at ``pose_time``.

    Raises:
        ValueError: when the frames are no single recording of one map, or too few.
    """
    pending = deque(_windows(np.array(stamps_ns, np.int64)))
    first_ns, last_ns = min(stamps_ns, default=0), max(stamps_ns, default=0)
    places = {stamp: place for place, stamp in reversed(list(enumerate(stamps_ns)))}
    in_order = sorted(places)
    near: dict[int, Localized] = {}
    maps: set[str] = set()
    count = smoothed = 0
    end_ns = 0

    def finish() -> SmoothedFrames:
        nonlocal smoothed, end_ns
        window = pending.popleft()
        # A frame of a rig without its first camera has the stamp of another, maybe beyond all.
        earliest_ns = window.first_ns if end_ns else min(near, default=0)
        latest_ns = window.last_ns if pending else max(near, default=0)
        known = sorted(s for s in near if earliest_ns <= s <= latest_ns)
        frames = [near[s] for s in known]
        for stamp in [s for s in known if pending and s < pending[0].first_ns]:
            del near[stamp]
        begin_ns, end_ns = end_ns, int(pending[0].stamps_ns[0]) if pending else latest_ns + 1
        others = np.array([s for s in known if begin_ns <= s < end_ns], np.int64)
        inputs = np.union1d(window.stamps_ns, others)
        if rate is not None:
            inputs = _moments(window.stamps_ns, first_ns, last_ns if not pending else None, rate)
        if not stretches((np.array(known, np.int64) - first_ns).astype(np.float64) * 1e-9):
            return SmoothedFrames([], inputs[:0], len(inputs), 0)
        smoothed += 1
        return _smoothed(localizer, frames, inputs, rate is not None)

    for frame in localized:
        count += 1
        maps.add(frame.map_frame)
        if len(maps) > 1:
            raise ValueError(f"points lie in several frames: {', '.join(sorted(maps))}")
        before = in_order[max(bisect_right(in_order, frame.input_stamp_ns) - 1, 0)]
        while pending and pending[0].last_place < places[before]:
            yield finish()
        near[frame.input_stamp_ns] = frame
    while count and pending:
        yield finish()
    if count and not smoothed:
        raise ValueError(f"{count} frames have a pose, none of them {LEAST_FRAMES} in a row")


def _windows(stamps_ns: IntArray) -> Iterator[_Window]:
    """Yield windows that hold images; the last one takes a rest of less than half a window."""
    if not len(stamps_ns):
        return
    order = np.argsort(stamps_ns, kind="stable")
    stamps = stamps_ns[order]
    most = max(round(int(stamps[-1] - stamps[0]) / _WINDOW_NS) - 1, 0)
    numbers = np.minimum((stamps - stamps[0]) // _WINDOW_NS, most)
    for number in np.unique(numbers).tolist():
        begin, end = np.searchsorted(numbers, [number, number + 1]).tolist()
        start_ns = int(stamps[0]) + number * _WINDOW_NS
        first = int(np.searchsorted(stamps, start_ns - _MARGIN_NS))
        last = len(stamps)
        if number < most:
            last = int(np.searchsorted(stamps, start_ns + _WINDOW_NS + _MARGIN_NS))
        yield _Window(
            np.unique(stamps[begin:end]), int(stamps[first]), int(stamps[last - 1]),
            int(order[first:last].max()),
        )  # fmt: skip


def _moments(stamps_ns: IntArray, first_ns: int, last_ns: int | None, rate: float) -> IntArray:
    """Return even moments of a window, counted from the first image of the recording.

    Args:
        stamps_ns: (m,) of the images in the window.
        first_ns: of the recording.
        last_ns: of the recording, if this is the last window.
        rate: Hz.
    """
    start_ns = first_ns + (int(stamps_ns[0]) - first_ns) // _WINDOW_NS * _WINDOW_NS
    end_ns = start_ns + _WINDOW_NS if last_ns is None else last_ns + 1
    count = [int((moment - first_ns) * 1e-9 * rate) for moment in (start_ns, end_ns)]
    moments = first_ns + np.round(np.arange(count[0], count[1] + 1) * 1e9 / rate).astype(np.int64)
    return moments[(moments >= start_ns) & (moments < end_ns)]


def _smoothed(
    localizer: FrameLocalizer, frames: list[Localized], inputs: IntArray, sampled_evenly: bool
) -> SmoothedFrames:
    """Return frames at the stamps ``inputs`` (m,) by the motion through ``frames``."""
    motion, moments = _motion(localizer, frames, inputs)
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
                inliers=nothing if own is None else own.inliers,
                dropped=0 if own is None else own.dropped,
                estimate=estimate,
                cameras=() if own is None else own.cameras,
            )
        )
        if not isinstance(frame, Refusal):
            result.append(frame)
            kept[k] = True
    without = sampled.bridged if sampled_evenly else ~np.isin(inputs, list(once))
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
