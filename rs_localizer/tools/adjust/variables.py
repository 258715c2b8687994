# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements, free unknowns, and their steps."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array, BoolArray, IntArray
from rs_localizer.core.camera import Camera
from rs_localizer.tools.adjust.intrinsics import lens_values
from rs_localizer.tools.adjust.spline import Layout, Spline

MOUNT, DELAY = 13, 6
"""Numbers of a gyroscope's mount: turn in its own axes, bias, delay, shape; place of the delay."""


@dataclass(frozen=True, slots=True, eq=False)
class GyroSamples:
    """Samples of a gyroscope."""

    times: Array  # (k,) s, by its own stamps
    rates: Array  # (k,3) rad/s, in its own axes
    deviation: float = np.inf  # rad/s, standard deviation of the noise of a sample and axis

    def covered(self, layout: Layout, delay: float, margin: float) -> BoolArray:
        """Return a mask (k,) of samples that a motion covers, ``margin`` s off its edges."""
        times = self.times + delay
        return layout.inside(times - margin) & layout.inside(times + margin)

    def subset(self, chosen: BoolArray) -> GyroSamples:
        """Return the chosen samples (k,)."""
        return GyroSamples(self.times[chosen], self.rates[chosen], self.deviation)


@dataclass(frozen=True, slots=True, eq=False)
class GyroMount:
    """How a gyroscope measures.

    It measures ``(1 + shape) camera_from_imu^T rate + bias`` of the camera's rate at ``t + delay``.
    The symmetric ``shape`` has the errors of a consumer gyroscope: the scales of its axes and the
    angles between them, a percent or so. Without it the readout time would absorb them.
    """

    camera_from_imu: Array  # (3,3)
    bias: Array  # (3,) rad/s, in its own axes
    delay: float  # s, to be added to its stamps to get the time of the spline
    shape: Array = field(default_factory=lambda: np.zeros(6))  # xx yy zz yz xz xy

    @property
    def matrix(self) -> Array:
        """(3,3), from the camera's rates to measured ones without bias."""
        xx, yy, zz, yz, xz, xy = self.shape
        symmetric = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        matrix: Array = (np.eye(3) + symmetric) @ self.camera_from_imu.T
        return matrix

    def moved(self, step: Array) -> GyroMount:
        """Return the mount after a step (13,)."""
        return GyroMount(
            self.camera_from_imu @ so3.exp(step[:3]), self.bias + step[3:6],
            self.delay + float(step[DELAY]), self.shape + step[DELAY + 1 :],
        )  # fmt: skip

    def beside(self, first: GyroMount) -> Array:
        """Return the step (13,) that leads here from a first guess, which has no shape."""
        turn = so3.log(np.ascontiguousarray(first.camera_from_imu.T @ self.camera_from_imu))
        step: Array = np.r_[turn, self.bias - first.bias, self.delay - first.delay, self.shape]
        return step

    def turned_from(self, given: Array) -> float:
        """Return the angle (rad) between its rotation and a given one (3,3)."""
        between = np.ascontiguousarray(given.T @ self.camera_from_imu)
        return float(np.linalg.norm(so3.log(between)))


@dataclass(frozen=True, slots=True, eq=False)
class SplineKeypoints:
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

    def subset(self, chosen: BoolArray) -> SplineKeypoints:
        """Return the chosen keypoints (n,), with all landmarks."""
        names = ("times", "row_times", "pixels", "points", "frames", "trusted")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


@dataclass(frozen=True, slots=True, eq=False)
class Extrinsics:
    """Place of a camera on a rig, ``X_camera = axes (X_rig - centre)``, and its clock."""

    axes: Array  # (3,3) camera_from_rig
    centre: Array  # (3,) m
    offset: float  # s, how much later than its stamp a middle row was exposed, by the rig's clock

    @classmethod
    def none(cls) -> Extrinsics:
        """Return the extrinsics of a camera whose axes are the rig's."""
        return cls(np.eye(3), np.zeros(3), 0.0)

    def moved(self, step: Array) -> Extrinsics:
        """Return the extrinsics after a step (7,): rotation in camera axes, centre, offset."""
        turned = so3.exp(np.ascontiguousarray(step[:3])) @ self.axes
        return Extrinsics(turned, self.centre + step[3:6], self.offset + float(step[6]))

    def beside(self, other: Extrinsics) -> Array:
        """Return the step (7,) that leads here from others."""
        turn = so3.log(np.ascontiguousarray(self.axes @ other.axes.T))
        step: Array = np.r_[turn, self.centre - other.centre, self.offset - other.offset]
        return step


@dataclass(frozen=True, slots=True)
class Freedom:
    """Unknowns beside the motion, and their priors."""

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
    mount: bool = False  # the camera's extrinsics on the rig that moves, and its clock


@dataclass(frozen=True, slots=True, eq=False)
class CameraView:
    """Keypoints of one camera, and what of it is free."""

    camera: Camera
    observations: SplineKeypoints
    freedom: Freedom

    def subset(self, chosen: BoolArray) -> CameraView:
        """Return the view with the chosen keypoints (n,)."""
        return replace(self, observations=self.observations.subset(chosen))


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """All that is estimated."""

    spline: Spline
    readout_time: float  # s; negative: against the scan direction of the camera
    lens: Array  # (m,) as of lens_values
    landmarks: Array  # (p,3) m
    delays: Array  # (g,) s, how much later than stamped each image was exposed
    mount: GyroMount | None = None  # of the gyroscope, where there is one
    # Extrinsics of the camera; the motion is that of the body on which it is mounted.
    extrinsics: Extrinsics = field(default_factory=Extrinsics.none)
    # Unknowns of the other cameras of a rig, which move along this spline.
    others: tuple[Unknowns, ...] = ()


def start_state(
    camera: Camera, observations: SplineKeypoints, spline: Spline, readout_time: float = 0.0
) -> Unknowns:
    """Return a first guess with the camera's own lens and the map as it is given."""
    delays = np.zeros(int(observations.frames.max(initial=-1)) + 1)
    return Unknowns(
        spline, readout_time, lens_values(camera), observations.landmarks.copy(), delays
    )


def rig_state(
    spline: Spline, cameras: Iterable[tuple[Camera, SplineKeypoints, Extrinsics]]
) -> Unknowns:
    """Return a first guess of cameras on one body, with their own readout times and clocks."""
    first, *others = (
        replace(start_state(camera, seen, spline, camera.readout_time), extrinsics=mounted)
        for camera, seen, mounted in cameras
    )
    return replace(first, others=tuple(others))
