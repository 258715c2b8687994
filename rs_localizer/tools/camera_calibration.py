# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A camera by a recording: readout time with an honest deviation, direction, lens, oddities."""

import math
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ACROSS, REVERSED, ScanDirection
from rs_localizer.io.imu import ImuRecording
from rs_localizer.localizer import Localizer
from rs_localizer.tools.adjust.fit import Fit, cheaper, fit, image_speeds
from rs_localizer.tools.adjust.intrinsics import LensErrors, lens_difference, lens_errors
from rs_localizer.tools.adjust.observe import ImagePoints, Posed, collect, in_order, localize_each
from rs_localizer.tools.adjust.spline import LONGEST_SPACING, Spline, first_spline, refined
from rs_localizer.tools.adjust.system import Undetermined
from rs_localizer.tools.adjust.variables import (
    DELAY,
    MOUNT,
    Freedom,
    SplineKeypoints,
    Unknowns,
    is_flat,
    start_state,
)
from rs_localizer.tools.imu_mount import MountFound, gyro_samples, mount_of, with_gyro
from rs_localizer.tools.readout_belief import (
    Block,
    Stamps,
    apart_of,
    disagreement,
    discrepancy,
    examine,
)
from rs_localizer.tracking import Tracker

# Parts of the recording that are calibrated on their own: three at least, for two that agree may do
# so by chance, and more of a longer one.
_BLOCK_SECONDS, _LEAST_BLOCKS, _MOST_BLOCKS = 3.0, 3, 8


def blocks_of(
    observations: SplineKeypoints, whole: Fit, count: int | None = None
) -> tuple[Block, ...]:
    """Return equal parts of the recording, each with its own lens and shape of the map.

    Args:
        count: of the parts; None: as many as the recording is long enough for.
    """
    first, last = observations.times.min(), observations.times.max()
    if count is None:
        count = int(np.clip((last - first) / _BLOCK_SECONDS, _LEAST_BLOCKS, _MOST_BLOCKS))
    blocks: list[Block] = []
    for start, end in pairwise(np.linspace(first, last + 1e-6, count + 1)):
        # Not only what fits the whole: a part that differs would be left out of its own estimate.
        part = observations.subset((observations.times >= start) & (observations.times < end))
        state = cut(whole.state, start, end)
        if state is None or not np.any(part.trusted):
            continue
        try:
            own = fit(part, state, whole.freedom)
        except ValueError:  # undetermined, or a lens that no camera has
            continue
        found = own.state
        delay = (math.nan, math.nan) if found.mount is None else (
            found.mount.delay, math.sqrt(float(own.border_covariance[DELAY - MOUNT, DELAY - MOUNT]))
        )  # fmt: skip
        blocks.append(Block(
            float(start), float(end), found.readout_time, own.readout_time_deviation, own.camera,
            found.landmarks, *delay,
        ))  # fmt: skip
    return tuple(blocks)


def cut(state: Unknowns, start: float, end: float) -> Unknowns | None:
    """Return the state with the motion between two times only."""
    layout = state.spline.layout
    intervals = np.column_stack([layout.starts, layout.ends])
    margin = max(abs(one.readout_time) for one in (state, *state.others))
    kept = np.clip(intervals, start - margin, end + margin)
    kept = kept[kept[:, 1] - kept[:, 0] > layout.spacing]
    if len(kept) == 0:
        return None
    return replace(state, spline=refined(state.spline, layout.spacing, kept))


_LEAST_IMAGES = 20
# A board: few landmarks, seen often. Each is where it should be to about this part of its size (a
# quarter of a millimetre of an A4 sheet), beside what bends all of it.
_MOST_BOARD_POINTS, _LEAST_SIGHTS, _BOARD_SHARE = 400, 30, 1e-3
_GIVEN_LENS = (0.02, 0.1)  # deviations of a given one, see Freedom.lens_deviations
# Images that were not taken at their even stamps may be missing others between them: the mean
# interval, and with it the readout time, is off by about this part of what they are off.
_INTERVAL_SHARE = 0.5
# Standard deviations of the images' own times, by the interval, to begin with.
_FIRST_JITTERS = (0.1, 0.3)
# Less than this does no harm, and may be a motion that the knots do not follow.
_LEAST_JITTER = 0.03
_LEAST_STAMPS = 1e-5  # s
# The prior of the accelerations is this many times their median, and at least this.
_ACCELERATIONS, _LEAST_ACCELERATION = 1.5, 0.3


# Parts that differ by this share of the value beyond chance, and by more than a value may be off:
# the camera may turn its picture.
_STABILISED = 0.1
_HALVES_SIGMAS = 3.0
# A readout time is determined to this part of the interval between images, 1.7 ms at 30 Hz: by the
# estimate itself a slow motion, which makes it too long, would make it better known. Nor do slow
# cameras have slow sensors.
_DETERMINED_SHARE, _LONGEST_INTERVAL = 0.05, 1.0 / 30.0
# Fewest parts that have to determine it by themselves, or length (s) that the recording has to
# have.
_LEAST_TELLING, _LONG = 3, 9.0
# A global shutter has 0 within this many deviations, and these within this (s): the fastest rolling
# shutters take 4 ms.
_GLOBAL_SIGMAS, _GLOBAL = 3.0, 2e-3
# Images that were exposed so far (s rms) beside their stamps have stamps that no camera gave.
_BESIDE = 1e-3
# Readouts cannot take longer than this part of the interval between images.
_LONGEST = 1.05


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """Findings of a recording on its camera, and whether its readout time is believed."""

    readout_time: float  # s; negative: against the scan direction that was given
    deviation: float  # s, with what blocks and halves disagree in, and doubts of the stamps
    blocks: tuple[Block, ...]
    halves: tuple[Block, ...]
    inflation: float  # of the deviation, because the blocks disagree; 1: they do not
    stamps: Stamps
    own_stamps: bool  # the images' own, not those of a rate
    jitter: float  # s rms, by how much images were exposed beside their stamps; 0: they were not
    seconds: float  # how long the images with a pose last
    turned: bool  # whether rows rotate otherwise than images
    fit: Fit
    posed: Posed
    images: int  # that show the map
    lens: LensErrors  # standard deviations of the lens that was found
    mount: MountFound | None = None  # of the IMU, where there is one
    no_mount: str = ""  # why there is none
    other_axis: bool = False  # the scan runs across the axis that was assumed

    @property
    def limit(self) -> float:
        """Deviation (s) from which on a readout time is not determined."""
        return _DETERMINED_SHARE * min(self.stamps.interval, _LONGEST_INTERVAL)

    @property
    def telling(self) -> int:
        """How many blocks determine it by themselves."""
        return sum(block.deviation < self.limit for block in self.blocks)

    @property
    def determined(self) -> bool:
        """True where the motion determines the readout time, and parts can speak against it."""
        long_enough = self.telling >= _LEAST_TELLING or self.seconds >= _LONG
        return self.deviation < self.limit and long_enough

    @property
    def near_zero(self) -> bool:
        """True where 0 lies within the error."""
        return abs(self.readout_time) < _GLOBAL_SIGMAS * self.deviation

    @property
    def global_shutter(self) -> bool:
        """True where nothing else than a global shutter is left."""
        sure = _GLOBAL_SIGMAS * self.deviation < _GLOBAL and self.inflation == 1.0
        return self.determined and self.near_zero and sure and self.own_stamps

    @property
    def sense(self) -> float:
        """The sign by which readout times of parts are those along the direction that is told."""
        return 1.0 if self.global_shutter else math.copysign(1.0, self.readout_time)

    @property
    def stabilised(self) -> bool:
        """True where the parts disagree as those of a camera that turns its picture do."""
        least = max(_STABILISED * abs(self.readout_time), self.limit)
        apart, noise = apart_of(self.halves)
        by_halves = apart > max(_HALVES_SIGMAS * noise, 2.0 * least)
        values = [block.readout_time for block in self.blocks]
        scatter = np.std(values, ddof=1) if len(values) > 1 else 0.0
        return bool((self.inflation > 1.0 and scatter > least) or by_halves)

    @property
    def processed(self) -> str:
        """Why the film is hardly what the camera saw, one sentence; '': nothing says so."""
        why = []
        if self.stabilised:
            parts = ", ".join(f"{1e3 * self.sense * one.readout_time:.2f}" for one in self.blocks)
            why.append(f"parts of the recording disagree ({parts} ms)")
        if self.jitter > _BESIDE:
            why.append(f"exposures are {1e3 * self.jitter:.1f} ms rms off their stamps")
        if self.turned:
            why.append("rows rotate otherwise than images")
        return (
            f"{' and '.join(why)}: is image stabilization on, or was the video processed? Record "
            "with the camera's own time stamps, without losing images or re-encoding the video"
            if why
            else ""
        )

    @property
    def disbelief(self) -> str:
        """One line with the figure when the readout time is not determined; or ''."""
        interval = 1e3 * self.stamps.interval
        slowest = abs(self.readout_time) + _GLOBAL_SIGMAS * self.deviation
        if self.processed:
            why = f"; {self.processed}"
        elif abs(self.readout_time) > _LONGEST * self.stamps.interval:
            why = f" is longer than {interval:.1f} ms between images: is the frame rate right?"
        elif not self.determined:
            why = (
                f" (limit {1e3 * self.limit:.1f} ms; {self.telling} of {len(self.blocks)} parts of "
                f"the {self.seconds:.1f} s determine it on their own, three must, or 9 s): move "
                "the camera faster, rotate it about all axes, and for longer"
            )
        elif not (self.near_zero or self.own_stamps) and slowest < _GLOBAL:
            why = "; no rolling shutter is that fast: was the video stabilized or processed?"
        elif self.near_zero and not self.global_shutter:
            why = (
                "; that is no proof of a global shutter: three deviations are more than 2 ms, its "
                "parts differ, or the stamps are those of a video that was processed"
            )
        else:
            return ""
        value = 1e3 * self.sense * self.readout_time
        return f"not observable: {value:.1f} +- {1e3 * self.deviation:.1f} ms{why}"

    @property
    def shape_deviation(self) -> float:
        """Deviation of landmarks (m, rms), by noise and half of what halves differ by."""
        count = 3 * len(np.unique(self.posed.observations.points))
        first = 1 + len(self.fit.state.lens)
        variances = np.diag(self.fit.border_covariance)[first : first + count]
        apart = 0.0
        if len(self.halves) == 2:
            one, other = (half.landmarks - half.landmarks.mean(axis=0) for half in self.halves)
            turn = Rotation.align_vectors(one, other)[0]
            apart = float(np.mean(np.sum((one - turn.apply(other)) ** 2, axis=1)))
        return math.sqrt(3.0 * self.inflation**2 * float(np.mean(variances)) + 0.25 * apart)


def calibrate_either_axis(
    camera: Camera, images: list[ImagePoints], **known: Any
) -> CameraCalibration:
    """Calibrate as :func:`calibrate`, and along the other axis if that is not believed.

    The other axis is returned if its readout time is believed and it leaves less noise: an image
    that is scanned across the assumed axis looks like one of a stabilizer.
    """
    found = calibrate(camera, images, **known)
    if found.disbelief:
        across = replace(camera, scan_direction=ACROSS[ScanDirection(camera.scan_direction)])
        with suppress(ValueError):  # a wrong axis may determine nothing
            other = calibrate(across, images, **known)
            if not other.disbelief and other.fit.deviation < found.fit.deviation:
                return replace(other, other_axis=True)
    return found


def calibrate(
    camera: Camera, images: list[ImagePoints], *, intrinsics: bool = False,
    imu: ImuRecording | None = None, own_stamps: bool = True,
) -> CameraCalibration:  # fmt: skip
    """Estimate readout time and lens of a camera from a recording in which it moves.

    Args:
        camera: its lens, and the axis and assumed direction of its scan; not its readout time.
        images: with at least a dozen correspondences each; those that show nothing say when the
            camera took images.
        intrinsics: the lens is to be found; otherwise it is known to a percent or two.
        imu: how it goes with the camera is to be found; its turns then help to find all else.
        own_stamps: stamps are the camera's; otherwise those of a file, which are the images' own
            only where they are uneven.

    Raises:
        ValueError: when the recording determines nothing, saying what was found.
    """
    taken = np.unique([image.stamp_ns for image in images])
    images = in_order(images)
    if len(images) < _LEAST_IMAGES:
        raise ValueError(f"{len(images)} images show the map, at least {_LEAST_IMAGES} are needed")
    stamps = examine((taken - taken[0]) * 1e-9)
    results = localize_each(camera, images)
    localized = sum(map(bool, results))
    if localized < _LEAST_IMAGES:
        failures = [str(result) for result in results if not result]
        raise ValueError(
            f"{localized} of {len(images)} images have a pose, at least {_LEAST_IMAGES} are "
            f"needed; of the last one without, {failures[-1]}"
        )
    posed = collect(camera, images, results)
    freedom = _freedom(posed.observations, intrinsics)
    fitted = _smooth(posed, stamps.interval, freedom)
    # Times of images and finer knots would follow what a stabilizer does, for minutes.
    turned = _is_turned(fitted, stamps.interval, images)
    if not turned:
        fitted = _best(posed, stamps.interval, fitted, freedom)
    observations, no_mount = within(posed.observations, fitted.state.spline), ""
    if imu is not None:
        try:
            samples = gyro_samples(imu, posed.start_ns)
            observations, fitted = with_gyro(observations, fitted, samples)
        except Undetermined as error:
            no_mount = str(error)
    return _judged(
        observations, fitted, stamps, posed=posed, images=len(images), no_mount=no_mount,
        own_stamps=own_stamps or stamps.irregular, turned=turned,
    )  # fmt: skip


def _is_turned(fitted: Fit, interval: float, images: list[ImagePoints]) -> bool:
    """Return :func:`is_turned` by the shutter that was found, if it is one."""
    readout_time, camera = fitted.state.readout_time, fitted.camera
    if not 3.0 * fitted.readout_time_deviation < abs(readout_time) < interval:
        return False
    if readout_time < 0.0:
        camera = replace(camera, scan_direction=REVERSED[ScanDirection(camera.scan_direction)])
    return is_turned(camera, images)


def is_turned(camera: Camera, images: list[ImagePoints]) -> bool:
    """Return whether rows of images rotate otherwise than the images, as of a stabilized film."""
    tracker = Tracker(Localizer(camera))
    middle_ns = round(-1e9 * camera.readout_time * camera.first_row_time)
    for image in images:
        tracker.localize(image.stamp_ns + middle_ns, image.points, image.pixels)
        if tracker.shutter.rows_turn:
            return True
    return False


def _freedom(observations: SplineKeypoints, intrinsics: bool) -> Freedom:
    landmarks, sights = observations.landmarks, len(observations.points)
    often = len(landmarks) <= min(_MOST_BOARD_POINTS, sights / _LEAST_SIGHTS)
    size = float(np.linalg.norm(np.ptp(landmarks, axis=0)))
    return Freedom(
        lens=True, lens_deviations=None if intrinsics else _GIVEN_LENS,
        landmarks=_BOARD_SHARE * size if often else 0.0, paper=often and is_flat(landmarks),
    )  # fmt: skip


def _smooth(posed: Posed, interval: float, freedom: Freedom) -> Fit:
    """Fit the readout time, then all that is free."""
    spline = first_spline(
        posed.times, posed.rotations, posed.positions, min(LONGEST_SPACING, interval),
        0.5 * interval,
    )  # fmt: skip
    observations = within(posed.observations, spline)
    plain = fit(observations, start_state(observations, spline, 0.0), Freedom())
    return fit(observations, plain.state, _calm(plain.state, freedom), plain.deviation)


def _best(posed: Posed, interval: float, fitted: Fit, freedom: Freedom) -> Fit:
    """Fit the images' times and finer knots, where they are worth it."""
    observations = within(posed.observations, fitted.state.spline)
    with suppress(Undetermined):  # a richer model that cannot be determined is no candidate
        other = _unsteady(observations, fitted, interval, freedom)
        unsteady = other.freedom.stamps > _LEAST_JITTER * interval
        if unsteady and cheaper(other, fitted, len(other.state.delays)):
            fitted = other
    with suppress(Undetermined):
        halved = refined(fitted.state.spline, 0.5 * min(LONGEST_SPACING, interval))
        state = replace(fitted.state, spline=halved)
        finer = fit(observations, state, fitted.freedom, fitted.deviation)
        added = 6 * (len(finer.state.spline.positions) - len(fitted.state.spline.positions))
        if cheaper(finer, fitted, added):
            fitted = finer
    return fitted


def _unsteady(observations: SplineKeypoints, fitted: Fit, interval: float, freedom: Freedom) -> Fit:
    """Fit a time of its own for each image, from tight to loose to its actual spread."""
    own, other = _calm(fitted.state, freedom), fitted
    for share in _FIRST_JITTERS:
        own = replace(own, stamps=share * interval)
        other = fit(observations, other.state, own)
    own = replace(own, stamps=max(_jitter(observations, other.state), _LEAST_STAMPS))
    return fit(observations, other.state, own, other.deviation)


def _jitter(observations: SplineKeypoints, state: Unknowns) -> float:
    """Return the rms distance (s) of the images' own times from their stamps.

    By how one image differs from the mean of its neighbours: times that drift are nearly a motion
    that drifts. And by the fast images: in slow ones a hundredth of a pixel, which may be the
    detector's error, is worth a millisecond.
    """
    speeds = image_speeds(observations, state)
    weights = np.bincount(observations.frames, speeds**2, len(state.delays))
    weights = np.minimum(weights[1:-1], np.minimum(weights[:-2], weights[2:]))
    beside = np.diff(state.delays, 2)
    return float(np.sqrt(weights @ beside**2 / (6.0 * np.sum(weights))))


def _calm(state: Unknowns, freedom: Freedom) -> Freedom:
    """Add a prior of the accelerations that the motion itself shows."""
    states = state.spline.states(state.spline.layout.control_times())
    angular, linear = (
        max(_ACCELERATIONS * float(np.sqrt(np.median(np.sum(of**2, axis=1)))), _LEAST_ACCELERATION)
        for of in (states.angular_acceleration, states.linear_acceleration)
    )
    return replace(freedom, angular_acceleration=angular, linear_acceleration=linear)


def within(observations: SplineKeypoints, spline: Spline) -> SplineKeypoints:
    """Return the keypoints that the motion covers."""
    return observations.subset(spline.layout.inside(observations.times))


def _judged(
    observations: SplineKeypoints, fitted: Fit, stamps: Stamps, *, posed: Posed, **known: Any
) -> CameraCalibration:
    """Return the findings, by parts of the recording, beside what is ``known`` of it."""
    blocks, halves = blocks_of(observations, fitted), blocks_of(observations, fitted, 2)
    # The relative deviation of the interval, if stamps are even and images were not. A variance
    # from this many images is no better known than this.
    chance = 1.0 + 2.0 * math.sqrt(2.0 / len(fitted.state.delays))
    unsaid = fitted.freedom.stamps**2 - chance * stamps.jitter**2
    share = _INTERVAL_SHARE * math.sqrt(max(unsaid, 0.0)) / stamps.interval
    values, deviations, delays, spreads = np.reshape(
        [(it.readout_time, it.deviation, it.delay, it.delay_deviation) for it in blocks], (-1, 4)
    ).T
    # Of images that are missing where stamps are even, each part has a share of its own.
    deviations = np.hypot(deviations, share * values)
    inflation, mount = disagreement(values, deviations), None
    if observations.gyro is not None:
        mount = mount_of(observations, fitted, disagreement(delays, spreads))
    at = slice(1, 1 + len(fitted.state.lens))
    lens = lens_errors(fitted.camera, inflation**2 * fitted.border_covariance[at, at])
    if len(halves) == 2:
        apart = np.array(lens_difference(halves[0].camera, halves[1].camera))
        lens = LensErrors(*np.hypot(lens, 0.5 * apart).tolist())
    deviation = math.hypot(
        fitted.readout_time_deviation * inflation,
        share * fitted.state.readout_time,
        0.5 * apart_of(halves)[0],
        discrepancy(fitted.state.readout_time, values, inflation * deviations),
    )
    return CameraCalibration(
        readout_time=fitted.state.readout_time, deviation=deviation, blocks=blocks, halves=halves,
        inflation=inflation, stamps=stamps, jitter=fitted.freedom.stamps, fit=fitted, posed=posed,
        seconds=float(np.ptp(posed.times)), lens=lens, mount=mount, **known,
    )  # fmt: skip
