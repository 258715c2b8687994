"""Where a map lies by an IMU: scale where nothing else tells it, z up, and a check of others."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rs_localizer.core.arrays import Array, IntArray
from rs_localizer.mapping import MappingError
from rs_localizer.mapping.anchors import Placement
from rs_localizer.mapping.inertial_metres import (
    NO_FORCES,
    InertialMetres,
    NoMetres,
    elsewhen,
    inertial_metres,
)
from rs_localizer.mapping.refine import RefinedMap
from rs_localizer.mapping.similarity import Similarity, upright
from rs_localizer.trajectory.imu import ImuRecording

# Scales of different sources disagree by more than this, and more than chance.
_DISAGREE, _SIGMAS = 0.03, 3.0
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
        told=f"the IMU, to {100.0 * metres.share:.2f} % (standard deviation)",
    )


def _compared(place: InertialPlace) -> InertialPlace:
    """With a doubt where the IMU says another scale."""
    assert place.metres is not None
    larger, share = place.larger, place.metres.share
    if abs(larger) <= max(_DISAGREE, _SIGMAS * share):
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
