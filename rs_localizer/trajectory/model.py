# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What the trajectory's estimator is given, what is free in it, and what it changes."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.trajectory.gyro import GyroMount, GyroSamples
from rs_localizer.trajectory.lens import lens_values
from rs_localizer.trajectory.normal_kernels import Accelerations
from rs_localizer.trajectory.spline import Spline


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """Keypoints of all frames."""

    times: Array  # (n,) s, when the middle row of their frame was exposed, readout time aside
    row_times: Array  # (n,) -0.5 at the first exposed row, 0.5 at the last
    pixels: Array  # (n,2) raw
    landmarks: Array  # (p,3) m, map frame
    points: IntArray  # (n,) rows of ``landmarks``
    frames: IntArray  # (n,) number of the image, rising
    trusted: BoolArray  # (n,) inliers of their frame alone
    gyro: GyroSamples | None = None
    # (p,) number of the free rigid body that each landmark is part of, from 0 on; -1: known.
    bodies: IntArray | None = None

    def subset(self, chosen: BoolArray) -> Observations:
        """The chosen keypoints (n,), with all landmarks."""
        names = ("times", "row_times", "pixels", "points", "frames", "trusted")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


@dataclass(frozen=True, slots=True, eq=False)
class Extrinsics:
    """Where a camera is on a rig, ``X_camera = axes (X_rig - centre)``, and its clock."""

    axes: Array  # (3,3) camera_from_rig
    centre: Array  # (3,) m
    offset: float  # s, how much later than its stamp a middle row was exposed, by the rig's clock

    @classmethod
    def none(cls) -> Extrinsics:
        """Of a camera whose axes are the rig's."""
        return cls(np.eye(3), np.zeros(3), 0.0)

    def moved(self, step: Array) -> Extrinsics:
        """After a step (7,): turn in camera axes, centre, offset."""
        turned = so3.exp(np.ascontiguousarray(step[:3])) @ self.axes
        return Extrinsics(turned, self.centre + step[3:6], self.offset + float(step[6]))

    def beside(self, other: Extrinsics) -> Array:
        """The step (7,) that leads here from others."""
        turn = so3.log(np.ascontiguousarray(self.axes @ other.axes.T))
        step: Array = np.r_[turn, self.centre - other.centre, self.offset - other.offset]
        return step


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """What is known of extrinsics beforehand."""

    given: Extrinsics
    deviations: Array  # (7,) of a step from there: rad, m, s; infinite: nothing


@dataclass(frozen=True, slots=True)
class Freedom:
    """What is estimated beside the motion."""

    readout_time: bool = True
    lens: bool = False
    # Standard deviations of the given lens: focal lengths and centre by focal length, distortion.
    # None: nothing is known but what lenses and sensors are like.
    lens_deviations: tuple[float, float] | None = (0.02, 0.1)
    landmarks: float = 0.0  # m, standard deviation of their places; 0: they are known
    paper: bool = False  # they are those of one flat print, which may be bent as well
    stamps: float = 0.0  # s, standard deviation of each image's stamp; 0: they are right
    angular_acceleration: float = 100.0  # rad/s^2, zero-mean prior at each control
    linear_acceleration: float = 50.0  # m/s^2
    # Time (s) in which accelerations fade; 0: those at neighbouring controls are independent.
    fading: float = 0.0
    # Likewise of the velocity of images that stand alone, in stretches of one interval; infinite:
    # nothing is known of it.
    angular_velocity: float = math.inf  # rad/s
    linear_velocity: float = math.inf  # m/s
    # The noise is at least this (px). Where images have hardly more keypoints than numbers of their
    # own, a robust estimate rejects all but those it can run through, and ends at no noise at all.
    least_noise: float = 1e-4  # recordings without noise are simulated
    # Where the camera is on the rig that the motion is of, and its clock; None: that is known.
    mounting: Mounting | None = None

    def accelerations(self, spacing: float) -> Accelerations:
        """What is expected of them at controls that are so far apart (s)."""
        memory = math.exp(-spacing / self.fading) if self.fading > 0.0 else 0.0
        return Accelerations(
            float(self.angular_acceleration), float(self.linear_acceleration), memory
        )


@dataclass(frozen=True, slots=True, eq=False)
class State:
    """All that is estimated."""

    spline: Spline
    readout_time: float  # s; negative: against the scan direction of the camera
    lens: Array  # (m,) as of lens_values
    landmarks: Array  # (p,3) m
    delays: Array  # (g,) s, how much later than stamped each image was exposed
    mount: GyroMount | None = None  # of the gyroscope, where there is one
    # Of the camera; the motion is that of what it is mounted to.
    extrinsics: Extrinsics = field(default_factory=Extrinsics.none)
    # Of the other cameras of a rig; they move along this spline, whatever theirs are.
    others: tuple[State, ...] = ()

    def with_landmarks(self, landmarks: Array) -> State:
        """With the same landmarks (p,3) for all cameras."""
        others = tuple(replace(one, landmarks=landmarks) for one in self.others)
        return replace(self, landmarks=landmarks, others=others)


def start_state(
    camera: Camera, observations: Observations, spline: Spline, readout_time: float = 0.0
) -> State:
    """A first guess with the camera's own lens and the map as it is given."""
    delays = np.zeros(int(observations.frames.max(initial=-1)) + 1)
    return State(spline, readout_time, lens_values(camera), observations.landmarks.copy(), delays)


def rig_state(spline: Spline, cameras: Iterable[tuple[Camera, Observations, Extrinsics]]) -> State:
    """A first guess of cameras on what moves, with their own readout times and clocks."""
    first, *others = (
        replace(start_state(camera, seen, spline, camera.readout_time), extrinsics=mounted)
        for camera, seen, mounted in cameras
    )
    return replace(first, others=tuple(others))
