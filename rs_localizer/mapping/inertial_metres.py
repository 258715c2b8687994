# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Scale and gravity of a refined map, from the IMU that went along, and a check of others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.inertial.gravity import STANDARD_GRAVITY
from rs_localizer.mapping import MappingError
from rs_localizer.mapping.anchors import Placement
from rs_localizer.mapping.gauge import Similarity, upright
from rs_localizer.mapping.refine import RefinedMap
from rs_localizer.trajectory.gyro import NoMount
from rs_localizer.trajectory.imu import ImuRecording
from rs_localizer.trajectory.imu_extrinsics import ImuExtrinsics, imu_extrinsics
from rs_localizer.trajectory.metric import (
    Lever,
    Means,
    Metric,
    NoMetric,
    mean_accelerations,
    metric,
)

# Where the IMU is, m: as TF says, which is drawn on paper; where nothing says so, in the same box.
_DRAWN, _SAME_BOX = 0.05, 0.1
# Quicker motion than of twice this period (s) or so many images counts for nothing: the images'
# spline lacks some of it.
_SPACING, _IMAGES = 0.15, 2.0
# A scale is determined to this part of it.
_MOST_SHARE = 0.05
# The mean of the readings in the map's axes is gravity, but for a bias and how speed changed.
_MOST_OFF = 0.1
# Axes are known to this (rad), or TF's count.
_MOST_TURN = np.radians(2.0)
_LEAST_SECONDS, _LEAST_COVERED = 3.0, 0.5
# A rotation that TF has otherwise by more than this (rad), and more than chance, is doubted.
_DOUBTED, _SIGMAS = np.radians(2.0), 4.0

NO_FORCES = "the IMU has no accelerometer (its messages hold no linear_acceleration)"


class NoMetres(ValueError):
    """The IMU says nothing of the map; the message says why."""


@dataclass(frozen=True, slots=True, eq=False)
class InertialMetres:
    """What an IMU says of a map."""

    metric: Metric
    mount: ImuExtrinsics
    share: float  # standard deviation of the scale, by it, with the disagreement of parts
    turned: float | None  # rad, between the rotation that was found and TF's; None: TF has none
    covered: float  # share of the motion that the accelerometer saw without a gap

    @property
    def determined(self) -> bool:
        """Whether the motion determines the scale."""
        return self.share < _MOST_SHARE

    @property
    def undetermined(self) -> str:
        """What is to be said where it does not."""
        return (
            f"the motion determines the scale to {100.0 * self.share:.0f} % only, "
            f"{100.0 * _MOST_SHARE:.0f} % are needed: move the camera to and fro by some "
            "decimetres, briskly and in all directions, for ten seconds or more"
        )

    @property
    def doubts(self) -> tuple[str, ...]:
        """What is odd about it."""
        doubts = []
        deviation = self.mount.turn_deviation
        if self.turned is not None and self.turned > max(_DOUBTED, _SIGMAS * deviation):
            doubts.append(
                f"the IMU's rotation in TF is {np.degrees(self.turned):.1f} deg off that of the "
                "motion, which is used"
            )
        if self.covered < _LEAST_COVERED:
            doubts.append(
                f"accelerometer readings without a gap cover {100.0 * self.covered:.0f} % of the "
                "motion only"
            )
        return tuple(doubts)


def inertial_metres(refined: RefinedMap, imu: ImuRecording) -> InertialMetres:
    """What an IMU says of scale and gravity of a map, in its frame.

    Args:
        refined: the map, and the motion of the camera in it.
        imu: what it measured meanwhile; its rotation and lever arm count as far as it says them.

    Raises:
        NoMetres: when IMU and camera do not go together, or nothing can be told, with the reason.
    """
    if imu.specific_forces is None:
        raise NoMetres(NO_FORCES)
    mount, turned = _mount(refined, imu)
    samples = imu.forces(refined.start_ns, mount.mount.delay)
    spacing = max(_SPACING, _IMAGES * float(np.median(np.diff(refined.times))))
    means = mean_accelerations(refined.spline, samples, mount.mount.camera_from_imu, spacing)
    _check(means, refined)
    try:
        scale_fit = metric(means, _lever(imu))
    except NoMetric as error:
        raise NoMetres(str(error)) from error
    covered = scale_fit.means * spacing / _length(refined)
    return InertialMetres(scale_fit, mount, scale_fit.inflation * scale_fit.share, turned, covered)


def _mount(refined: RefinedMap, imu: ImuRecording) -> tuple[ImuExtrinsics, float | None]:
    """How the IMU hangs on the camera, and by how much (rad) TF has it otherwise."""
    given = imu.camera_from_imu
    try:
        mount = imu_extrinsics(imu.samples(refined.start_ns), refined.spline, given)
    except NoMount as error:
        ends = refined.start_ns * 1e-9 + refined.times[[0, -1]]
        raise NoMetres(elsewhen(imu, *ends.tolist()) or str(error)) from error
    if mount.turn_deviation > _MOST_TURN:
        if given is None:
            raise NoMetres(
                f"the rotation between IMU and camera is known to "
                f"{np.degrees(mount.turn_deviation):.0f} deg only: turn the camera about all axes, "
                "or give the rotation by TF"
            )
        return replace(mount, mount=replace(mount.mount, camera_from_imu=given)), None
    return mount, None if given is None else mount.mount.turned_from(given)


def elsewhen(imu: ImuRecording, first: float, last: float) -> str:
    """What is to be said where an IMU was not read from ``first`` to ``last`` (s), else nothing."""
    begin, end = 1e-9 * imu.stamps_ns.min(), 1e-9 * imu.stamps_ns.max()
    if begin < last and end > first:
        return ""
    return (
        f"its stamps are {begin:.3f} to {end:.3f} s, those of the images {first:.3f} to {last:.3f} "
        "s: they must be by one clock"
    )


def _check(means: list[Means], refined: RefinedMap) -> None:
    """That there are enough readings, and that they are specific forces in m/s^2."""
    seconds = sum(part.spacing * len(part.times) for part in means)
    if seconds < _LEAST_SECONDS:
        raise NoMetres(
            f"{seconds:.1f} of {_length(refined):.1f} s of the motion have readings of the "
            f"accelerometer without a gap, at least {_LEAST_SECONDS:.0f} s are needed"
        )
    forces = np.concatenate([part.forces for part in means])
    length = float(np.linalg.norm(forces.mean(axis=0)))
    if abs(length / STANDARD_GRAVITY - 1.0) > _MOST_OFF:
        raise NoMetres(
            f"the accelerometer's mean reading in the map's axes is {length:.3g} long, gravity is "
            f"{STANDARD_GRAVITY:.2f} m/s^2: {_why(length)}"
        )


def _length(refined: RefinedMap) -> float:
    """Of the motion, s."""
    layout = refined.spline.layout
    return float(np.sum(layout.ends - layout.starts))


def _why(length: float) -> str:
    """What makes the mean reading so long."""
    if abs(length - 1.0) < _MOST_OFF:
        return "it seems to count in g"
    if length < _MOST_OFF * STANDARD_GRAVITY:
        return "gravity seems to have been taken off, which must stay in"
    return "other units, or other axes than those of the gyroscope"


def _lever(imu: ImuRecording) -> Lever:
    if imu.imu_in_camera is None or not imu.imu_in_camera.any():
        return Lever(np.zeros(3), _SAME_BOX)
    return Lever(imu.imu_in_camera, _DRAWN)


# Scales of different sources disagree by more than this, and more than chance.
_DISAGREE, _DISAGREE_SIGMAS = 0.03, 3.0
# A direction of gravity that is known to this (rad) is up.
_MOST_TILT = np.radians(2.0)
_MOST_OFFSET = 2e-3  # s


@dataclass(frozen=True, slots=True, eq=False)
class GivenImu:
    """An IMU that went along."""

    recording: ImuRecording
    asked: bool  # no map without its scale, unless something else gives one


@dataclass(frozen=True, slots=True, eq=False)
class InertialPlace:
    """Where a map lies, by all that says so."""

    placement: Placement
    metres: InertialMetres | None = None  # what the IMU says; None: there is none, or nothing
    doubts: tuple[str, ...] = ()
    checked: bool = False  # the scale is another's, and the IMU says something of it

    @property
    def larger(self) -> float:
        """By how much (share) the map would be larger by the IMU than it is."""
        assert self.metres is not None
        return self.metres.metric.scale / self.placement.similarity.scale - 1.0

    @property
    def time_offset(self) -> float | None:
        """s, to add to a stamp of the IMU to get the camera's time; None: not known."""
        if self.metres is None or self.metres.mount.delay_deviation > _MOST_OFFSET:
            return None
        return self.metres.mount.mount.delay

    @property
    def tilt(self) -> float:
        """Angle (rad) between gravity and -z of the map."""
        assert self.metres is not None
        down = self.placement.similarity.rotation @ self.metres.metric.gravity
        return float(np.arctan2(np.hypot(down[0], down[1]), -down[2]))


def refuse_early(imu: GivenImu, stamps_ns: IntArray) -> None:
    """Before minutes of work: an IMU that has to give the scale, and plainly cannot.

    Args:
        stamps_ns: (n,) of the images.

    Raises:
        MappingError: when it has to, and was read at another time or without an accelerometer.
    """
    first, last = 1e-9 * stamps_ns.min(), 1e-9 * stamps_ns.max()
    fault = elsewhen(imu.recording, first, last)
    if imu.recording.specific_forces is None:
        fault = NO_FORCES
    if imu.asked and fault:
        raise MappingError(f"the IMU gives no scale: {fault}")


def place_by_imu(placement: Placement, refined: RefinedMap, imu: GivenImu | None) -> InertialPlace:
    """The frame of the map, with what an IMU adds to it.

    Args:
        placement: by markers or distances, or by nothing.

    Raises:
        MappingError: when the IMU was to give the scale, and does not.
    """
    if imu is None:
        return InertialPlace(placement)
    try:
        metres = inertial_metres(refined, imu.recording)
    except NoMetres as error:
        return InertialPlace(placement, None, (_missing(placement, imu, str(error)),))
    origin = refined.poses()[1][0]
    if not placement.levelled and metres.metric.gravity_deviation < _MOST_TILT:
        placement = _levelled(placement, metres, origin)
    if placement.scaled:
        return _compared(InertialPlace(placement, metres, metres.doubts, checked=True))
    if not metres.determined:
        missing = _missing(placement, imu, metres.undetermined)
        return InertialPlace(placement, metres, (*metres.doubts, missing))
    return InertialPlace(_scaled(placement, metres, origin), metres, metres.doubts)


def _levelled(placement: Placement, metres: InertialMetres, origin: Array) -> Placement:
    """With z up."""
    scale, turn = placement.similarity.scale, upright(metres.metric.gravity)
    deviation = np.degrees(metres.metric.gravity_deviation)
    return replace(
        placement,
        similarity=Similarity(scale, turn, -scale * turn @ origin),
        levelled=True,
        up=f"by the IMU, to {deviation:.2f} deg (standard deviation)",
    )


def _scaled(placement: Placement, metres: InertialMetres, origin: Array) -> Placement:
    """In metres."""
    scale, turn = metres.metric.scale, placement.similarity.rotation
    return replace(
        placement,
        similarity=Similarity(scale, turn, -scale * turn @ origin),
        scaled=True,
        basis=f"the IMU, to {100.0 * metres.share:.2f} % (standard deviation)",
    )


def _compared(place: InertialPlace) -> InertialPlace:
    """With a doubt where the IMU says another scale."""
    assert place.metres is not None
    larger, share = place.larger, place.metres.share
    if abs(larger) <= max(_DISAGREE, _DISAGREE_SIGMAS * share):
        return place
    size = "larger" if larger > 0.0 else "smaller"
    doubt = (
        f"by the IMU everything is {100.0 * abs(larger):.1f} % {size} (deviation "
        f"{100.0 * share:.1f} %): check the sizes of the markers, or the distances, and the "
        "accelerometer"
    )
    return replace(place, doubts=(*place.doubts, doubt))


def _missing(placement: Placement, imu: GivenImu, why: str) -> str:
    """What is said of an IMU that gives no scale; raises MappingError where it had to."""
    if placement.scaled:
        return f"the IMU cannot check the scale: {why}"
    if imu.asked:
        raise MappingError(f"the IMU gives no scale: {why}")
    return f"the IMU gives no scale: {why}"
