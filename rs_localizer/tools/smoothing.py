# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The motion of a whole recording: poses and velocities at any time, with covariance.

What the keypoints say of a motion's accelerations (MacKay, "Bayesian interpolation", Neural
Computation 4, 1992).

The accelerations of an estimate are too small, as far as the prior took the place of what the
keypoints do not tell; and their squares are the sum of as many numbers only as these do tell.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.config import PoseTime
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.rig import Rig, RigEstimate
from rs_localizer.core.state import MOTION_PARAMETERS, PARAMETERS
from rs_localizer.core.types import Estimate, roughness
from rs_localizer.io.outputs import Localized
from rs_localizer.offline.replay import inlier_columns
from rs_localizer.pipeline.frames import FrameLocalizer
from rs_localizer.pipeline.pose_at_time import pose_at, published_moment, twist_at
from rs_localizer.pipeline.published import of_body
from rs_localizer.pipeline.refusal import Refusal
from rs_localizer.pipeline.rig_frames import RigFrames
from rs_localizer.tools.adjust.factors import acceleration_rows
from rs_localizer.tools.adjust.fit import Fit, cheaper, solve
from rs_localizer.tools.adjust.observe import ImagePoints, collect
from rs_localizer.tools.adjust.problem import Problem
from rs_localizer.tools.adjust.reprojection import LIMIT
from rs_localizer.tools.adjust.spline import LONGEST_SPACING, first_spline, refined
from rs_localizer.tools.adjust.spline_kernels import CONTROL
from rs_localizer.tools.adjust.variables import (
    CameraView,
    Extrinsics,
    Freedom,
    SplineKeypoints,
    Unknowns,
    rig_state,
)

# Prior of the accelerations, worth this many numbers of this size (rad/s^2, m/s^2). A few images
# that happen to lie on a line tell nothing of those that follow.
_NUMBERS, _USUAL = 6.0, np.array([2.0, 1.0])


def squares_and_numbers(fitted: Fit) -> tuple[Array, Array]:
    """Return evidence on the expected accelerations, angular and linear.

    Returns:
        their sums of squares (2,), (rad/s^2)^2 and (m/s^2)^2, and how many numbers (2,) the
        keypoints tell.
    """
    expected = fitted.freedom
    rows = acceleration_rows(fitted.state.spline, expected)
    spread = fitted.factored.local_covariances(rows.first // CONTROL)
    variances = np.einsum("nri,nij,nrj->nr", rows.values, spread, rows.values)
    each = np.array([rows.errors**2, variances]).reshape(2, len(rows.errors), 2, 3)
    squares, unknown = each.sum(axis=(1, 3))
    usual = np.array([expected.angular_acceleration, expected.linear_acceleration]) ** 2
    return usual * squares, 3 * len(rows.first) - unknown


# Between images the motion is told as long as its deviations stay within this many of the usual
# ones.
_MOST_UNCERTAIN = 5.0
# A sample is bridged where the images with a pose lie farther apart than this many intervals.
_BRIDGED = 1.5
# If images show how accelerations fade, that bridges the knots (s) between them. Knots then need
# not be as wide as a hand's motion would allow, and narrow ones follow all of it.
_NARROW_SPACING = 0.025
# s, in which accelerations fade: hands and drones change them about twice a second.
_FADING = 0.1
# A frame whose points lie this much farther from the smooth motion than from its own is shaken in a
# way that knots cannot follow: by this many times the noise, and beyond the chance (this many
# standard deviations) of its points. Where so much of the frames is, the motion between them is
# none.
_SHAKEN, _SHAKEN_SIGMAS, _MOST_SHAKEN = 1.5, 5.0, 0.2
# rad per readout that is known beside a parabola: vibration.
_ROUGH = 2e-3
Parts = list[SplineKeypoints]
"""Keypoints of each camera."""
# The expected accelerations are settled when they change by less than this part.
_ALIKE, _ROUNDS = 0.05, 6


@dataclass(frozen=True, slots=True, eq=False)
class Sampled:
    """The motion at m times."""

    estimates: list[Estimate]  # per readout, as of single frames; no keypoints
    determined: BoolArray  # (m,) by the images before and after
    bridged: BoolArray  # (m,) with images missing next to it


@dataclass(frozen=True, slots=True, eq=False)
class Smoothed:
    """The motion through all images of a recording."""

    fit: Fit
    readout_time: float  # s
    start_ns: int
    times: Array  # (f,) s since then, of the images' middle rows
    # (f,) images that shake faster than the motion: their own estimates are better.
    shaken: BoolArray

    def sample(self, stamps_ns: IntArray) -> Sampled:
        """Return the camera's motion at times (m,) in ns."""
        times = np.array([(int(stamp) - self.start_ns) * 1e-9 for stamp in stamps_ns])
        covariances = self._in_camera(times)
        usual = np.median(_deviations(self._in_camera(self.times)), axis=0)
        certain = np.all(_deviations(covariances) < _MOST_UNCERTAIN * usual, axis=1)
        last = len(self.times) - 1
        before = np.maximum(np.searchsorted(self.times, times, side="right") - 1, 0)
        after = np.minimum(np.searchsorted(self.times, times), last)
        following = np.clip(after, 1, last)
        apart = self.times[following] - self.times[following - 1]
        vibrates = self.shaken[before] | self.shaken[after]
        return Sampled(
            self._estimates(times, covariances),
            self.fit.state.spline.layout.inside(times) & certain & ~vibrates,
            apart > _BRIDGED * np.median(np.diff(self.times)),
        )

    def _in_camera(self, times: Array) -> Array:
        """Return covariances (m,12,12) in order and axes of ``Estimate.covariance``, SI."""
        states = self.fit.state.spline.states(times)
        back = np.swapaxes(states.rotations, 1, 2)
        velocities = np.einsum("nij,nj->ni", back, states.linear)
        to_camera = np.zeros((len(times), 12, 12))
        to_camera[:, :3, :3] = to_camera[:, 6:9, 6:9] = np.eye(3)
        to_camera[:, 3:6, 3:6] = to_camera[:, 9:, 9:] = back
        to_camera[:, 9:, :3] = so3.hat(velocities)
        covariances: Array = (
            to_camera @ self.fit.state_covariances(times) @ np.swapaxes(to_camera, 1, 2)
        )
        return covariances

    def _estimates(self, times: Array, covariances: Array) -> list[Estimate]:
        states = self.fit.state.spline.states(times)
        scale = np.repeat([1.0, self.readout_time], 6)
        empty = np.zeros(0)
        # At a moment between images accelerations are not needed.
        joint = np.zeros((len(times), PARAMETERS, PARAMETERS))
        joint[:, :MOTION_PARAMETERS, :MOTION_PARAMETERS] = scale[:, None] * covariances * scale
        return [
            Estimate(
                rotation=rotation.T, translation=-rotation.T @ position,
                angular_velocity=self.readout_time * angular,
                linear_velocity=self.readout_time * (rotation.T @ linear),
                inliers=empty.astype(np.bool_), residuals=empty, joint_covariance=covariance,
                iterations=0, span=self.readout_time,
            )
            for rotation, position, angular, linear, covariance in zip(
                states.rotations, states.positions, states.angular, states.linear, joint,
                strict=True,
            )
        ]  # fmt: skip


def _deviations(covariances: Array) -> Array:
    """Return standard deviations (m,2) of orientation and position."""
    variances = np.diagonal(covariances, axis1=1, axis2=2)[:, :6]
    return np.asarray(np.sqrt(variances.reshape(-1, 2, 3).sum(axis=2)))


@dataclass(frozen=True, slots=True, eq=False)
class PosedFrame:
    """A frame with a pose, and the views of the cameras by their names."""

    time_ns: int  # of the pose
    images: Mapping[str, ImagePoints]  # their inliers; stamps are exposures of first rows
    estimate: Estimate


def smooth(rig: Rig, frames: list[PosedFrame]) -> Smoothed:
    """Return the motion of a rig, or of a single camera, through frames in their order.

    Args:
        rig: with the readout times of its cameras.
        frames: with a first motion each.

    Raises:
        ValueError: without a readout time, or when the frames determine no motion.
    """
    readout_time = next(iter(rig.cameras.values())).readout_time
    if not readout_time > 0.0:
        raise ValueError("smoothing needs the readout time of the camera, which is 0 (unknown)")
    if not frames:
        raise ValueError("no image has a pose: there is nothing to smooth")
    start_ns, estimates = frames[0].time_ns, [frame.estimate for frame in frames]
    times = np.array([(frame.time_ns - start_ns) * 1e-9 for frame in frames])
    interval = float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    fading = _FADING if interval < 0.5 * _FADING else 0.0  # 0: accelerations never fade
    spacing = min(_NARROW_SPACING if fading else LONGEST_SPACING, interval)
    rotations = np.array([one.rotation.T for one in estimates])
    positions = np.array([one.position for one in estimates])
    parts, mounted = _parts(rig, frames, start_ns)
    longest = max(readout_time, *(one.span for one in estimates))
    spline = first_spline(times, rotations, positions, spacing, longest)
    parts = [seen.subset(spline.layout.inside(seen.times)) for seen in parts]
    start = rig_state(spline, zip(parts, mounted, strict=True))
    best = _best(parts, start, fading)
    shaken = _shaken(best, parts, estimates)
    if shaken.mean() > _MOST_SHAKEN:
        shaken[:] = True
    return Smoothed(best, readout_time, start_ns, times, shaken)


def _parts(rig: Rig, frames: list[PosedFrame], start_ns: int) -> tuple[Parts, list[Extrinsics]]:
    """Return keypoints and mounts of the cameras that saw something."""
    parts, mounted = list[SplineKeypoints](), list[Extrinsics]()
    for name, camera in rig.cameras.items():
        own = [k for k, frame in enumerate(frames) if name in frame.images]
        if not own:
            continue
        images = [frames[k].images[name] for k in own]
        known = [
            replace(frames[k].estimate, inliers=np.ones(len(image.points), np.bool_))
            for k, image in zip(own, images, strict=True)
        ]
        posed = collect(camera, images, list(known), -camera.readout_time * camera.first_row_time)
        seen, shift = posed.observations, (posed.start_ns - start_ns) * 1e-9
        frames_of = np.array(own)[seen.frames]
        parts.append(replace(seen, times=seen.times + shift, frames=frames_of))
        axes, moved = rig.camera_from_rig[name]
        mounted.append(Extrinsics(axes, -axes.T @ moved, 0.0))
    return parts, mounted


def _best(parts: Parts, start: Unknowns, fading: float) -> Fit:
    """Fit with the accelerations that the motion shows, and finer knots if worth it."""
    fitted = _lively(parts, _solved(parts, start, Freedom(readout_time=False, fading=fading)))
    spline = fitted.state.spline
    halved = replace(fitted.state, spline=refined(spline, 0.5 * spline.layout.spacing))
    finer = _lively(parts, _solved(parts, halved, fitted.freedom, fitted.deviation))
    more = np.sum(squares_and_numbers(finer)[1]) - np.sum(squares_and_numbers(fitted)[1])
    return finer if cheaper(finer, fitted, float(more)) else fitted


def _solved(parts: Parts, start: Unknowns, freedom: Freedom, deviation: float | None = None) -> Fit:
    views = [CameraView(part, freedom) for part in parts]
    return solve(Problem(views, start), start, deviation)


def _shaken(fitted: Fit, parts: Parts, estimates: list[Estimate]) -> BoolArray:
    """Return a mask (f,) of images with vibration that the motion does not follow."""
    frames = np.concatenate([seen.frames for seen in parts])
    own = np.array([max(one.residual_rms, fitted.freedom.least_noise) ** 2 for one in estimates])
    count = np.bincount(frames, minlength=len(estimates))
    # Robust, as the estimates are: outliers of the motion count as its limit.
    squared = np.minimum(fitted.squared_errors, (LIMIT * fitted.deviation) ** 2)
    off = np.bincount(frames, squared, len(estimates)) / np.maximum(count, 1)
    # An estimate's errors are those of two coordinates, less what it took to fit them.
    freedom = np.maximum(1.0 - PARAMETERS / np.maximum(2 * count, 1), 0.1)
    limit = np.maximum(_SHAKEN**2, 1.0 + _SHAKEN_SIGMAS / np.sqrt(np.maximum(count, 1)))
    shaken = (count > 0) & (off > limit * own / freedom)
    # Or more than their points tells of it.
    rough = [one.aided and roughness(one) > _ROUGH for one in estimates]
    return np.asarray(shaken | rough, np.bool_)


def _lively(parts: Parts, fitted: Fit) -> Fit:
    """Add a prior of the accelerations that the motion itself shows.

    Each round is a step nearer to the greatest marginal likelihood.
    """
    for _ in range(_ROUNDS):
        before, (squares, numbers) = fitted.freedom, squares_and_numbers(fitted)
        known = np.maximum(numbers, 0.0) + _NUMBERS
        angular, linear = np.sqrt((squares + _NUMBERS * _USUAL**2) / known).tolist()
        freedom = replace(before, angular_acceleration=angular, linear_acceleration=linear)
        fitted = _solved(parts, fitted.state, freedom, fitted.deviation)
        changed = angular / before.angular_acceleration, linear / before.linear_acceleration
        if np.all(np.abs(np.log(changed)) < _ALIKE):
            break
    return fitted


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedFrames:
    """Frames of a recording by all its images."""

    frames: list[Localized]
    bridged: IntArray  # (b,) ns, stamps of those without an image of their own
    undetermined: int  # moments that neighbours do not determine
    shaken: int  # images that no smooth motion follows, as they shake: they keep their own poses


def smooth_frames(
    localizer: FrameLocalizer, localized: Iterable[Localized], stamps_ns: list[int],
    rate: float | None,
) -> SmoothedFrames:  # fmt: skip
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
    for k, (stamp, estimate) in enumerate(zip(inputs.tolist(), sampled.estimates, strict=True)):
        own = once.get(stamp)
        frame: Localized | Refusal | None = None
        if own is not None and (stamp in own_poses or not sampled.determined[k]):
            frame, shaken = own, shaken + 1
        elif sampled.determined[k]:
            of_camera = Localized(
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
            frame = of_body(of_camera, localizer.config, localizer.transforms)
        if frame:
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
        rig, offset_ns, delay_ns = localizer.rig, 0, 0
    else:
        assert calibration is not None
        camera = calibration.camera(config.readout_time, config.scan_direction)
        rig, offset_ns = Rig.of(camera), round(1e9 * config.stamp_offset)
        delay_ns = round(-1e9 * camera.readout_time * camera.first_row_time)
    posed = []
    for frame in frames:
        points, pixels = (inlier_columns(frame, names) for names in ("xyz", "uv"))
        if isinstance(frame.estimate, RigEstimate):
            ends = np.cumsum([share.inliers for share in frame.cameras])[:-1]
            parts = zip(frame.cameras, np.split(points, ends), np.split(pixels, ends), strict=True)
            images = {share.name: ImagePoints(share.start_ns, *own) for share, *own in parts}
            # Times of a rig's estimate count from its first image.
            time_ns = frame.cameras[0].start_ns + round(1e9 * frame.estimate.time)
        else:
            start_ns = frame.input_stamp_ns + offset_ns
            (name,), time_ns = rig.cameras, start_ns + delay_ns
            images = {name: ImagePoints(start_ns, points, pixels)}
        posed.append(PosedFrame(time_ns, images, frame.estimate))
    if not isinstance(localizer, RigFrames):
        return smooth(rig, posed), inputs + published_moment(config, camera, 0)[0]
    if config.pose_time == PoseTime.MID_FRAME:
        pairs = zip(frames, posed, strict=True)
        delays = {f.input_stamp_ns: r.time_ns - f.input_stamp_ns for f, r in pairs}
        usual = round(float(np.median(list(delays.values()))))
        inputs = inputs + np.array([delays.get(stamp, usual) for stamp in inputs.tolist()])
    return smooth(rig, posed), inputs
