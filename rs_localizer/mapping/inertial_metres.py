"""Scale and gravity of a refined map, from the IMU that went along with the camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.inertial.gravity import STANDARD_GRAVITY
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
                f"TF has another rotation between camera and IMU than their turns, "
                f"{np.degrees(self.turned):.1f} deg off; that of the turns is used"
            )
        if self.covered < _LEAST_COVERED:
            doubts.append(
                f"the accelerometer's readings without a gap are {100.0 * self.covered:.0f} % of "
                "the motion only"
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
        found = metric(means, _lever(imu))
    except NoMetric as error:
        raise NoMetres(str(error)) from error
    covered = found.means * spacing / _length(refined)
    return InertialMetres(found, mount, found.inflation * found.share, turned, covered)


def _mount(refined: RefinedMap, imu: ImuRecording) -> tuple[ImuExtrinsics, float | None]:
    """How the IMU hangs on the camera, and by how much (rad) TF has it otherwise."""
    given = imu.camera_from_imu
    try:
        found = imu_extrinsics(imu.samples(refined.start_ns), refined.spline, given)
    except NoMount as error:
        ends = refined.start_ns * 1e-9 + refined.times[[0, -1]]
        raise NoMetres(elsewhen(imu, *ends.tolist()) or str(error)) from error
    if found.turn_deviation > _MOST_TURN:
        if given is None:
            raise NoMetres(
                f"the rotation between IMU and camera is known to "
                f"{np.degrees(found.turn_deviation):.0f} deg only: turn the camera about all axes, "
                "or give the rotation by TF"
            )
        return replace(found, mount=replace(found.mount, camera_from_imu=given)), None
    if given is None:
        return found, None
    between = np.ascontiguousarray(given.T @ found.mount.camera_from_imu)
    return found, float(np.linalg.norm(so3.log(between)))


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
