# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Measurements, free unknowns, and their steps.

Landmarks move together: each free one by itself, or the corners of one rigid marker.
"""

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
        return np.asarray((np.eye(3) + symmetric) @ self.camera_from_imu.T)

    def moved(self, step: Array) -> GyroMount:
        """Return the mount after a step (13,)."""
        return GyroMount(
            self.camera_from_imu @ so3.exp(step[:3]), self.bias + step[3:6],
            self.delay + float(step[DELAY]), self.shape + step[DELAY + 1 :],
        )  # fmt: skip

    def beside(self, first: GyroMount) -> Array:
        """Return the step (13,) that leads here from a first guess, which has no shape."""
        turn = so3.log(np.ascontiguousarray(first.camera_from_imu.T @ self.camera_from_imu))
        return np.asarray(np.r_[turn, self.bias - first.bias, self.delay - first.delay, self.shape])


@dataclass(frozen=True, slots=True, eq=False)
class SplineKeypoints:
    """Keypoints of all frames of one camera."""

    camera: Camera  # its lens, size and scan
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
        return np.asarray(np.r_[turn, self.centre - other.centre, self.offset - other.offset])


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

    observations: SplineKeypoints
    freedom: Freedom

    @property
    def camera(self) -> Camera:
        return self.observations.camera

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


def start_state(seen: SplineKeypoints, spline: Spline, readout_time: float) -> Unknowns:
    """Return a first guess with the camera's own lens and the map as it is given."""
    delays = np.zeros(int(seen.frames.max(initial=-1)) + 1)
    return Unknowns(spline, readout_time, lens_values(seen.camera), seen.landmarks.copy(), delays)


def rig_state(spline: Spline, cameras: Iterable[tuple[SplineKeypoints, Extrinsics]]) -> Unknowns:
    """Return a first guess of cameras on one body, with their own readout times and clocks."""
    first, *others = (
        replace(start_state(seen, spline, seen.camera.readout_time), extrinsics=mounted)
        for seen, mounted in cameras
    )
    return replace(first, others=tuple(others))


PLACE, BODY = 3, 6
"""Numbers of a free point, and of a body: its place, then its turn in the map's axes."""

_FLAT = 1e-6  # thickness of a plane by its size: rounding of single precision
# Standard deviations by half the size of a print. Paper curls by one part in a hundred (2 mm of an
# A4 sheet), in waves that are smaller the shorter they are; printers and screens stretch one
# direction by up to three parts in a thousand more than the other.
_BENDS = {2: 1e-2, 3: 5e-3, 4: 2.5e-3}  # by the degree of the polynomial
_STRETCH = 3e-3


def is_flat(points: Array) -> bool:
    """Return True if points (p,3) lie in one plane."""
    sizes = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(sizes[2] < _FLAT * sizes[0])


def paper_covariance(points: Array, deviation: float) -> Array:
    """Return the covariance (3 p, 3 p) of the errors of points (p,3) on a flat print.

    Out of the plane low polynomials, which neither turn nor shift it, in the plane stretch and
    shear; and of each point by itself its ``deviation`` (m).
    """
    middle = points.mean(axis=0)
    axes = np.linalg.svd(points - middle)[2]
    flat = (points - middle) @ axes[:2].T
    half = 0.5 * float(np.ptp(flat, axis=0).max())
    x, y = (flat / half).T
    plane = np.column_stack([np.ones_like(x), x, y])
    modes = [
        _STRETCH * (np.outer(along, axes[0]) + np.outer(across, axes[1]))
        for along, across in ((x, -y), (y, x))
    ]
    for degree, size in _BENDS.items():
        for power in range(degree + 1):
            bend = x ** (degree - power) * y**power
            bend = bend - plane @ np.linalg.lstsq(plane, bend, rcond=None)[0]
            modes.append(size * np.outer(bend, axes[2]))
    root = half * np.reshape(modes, (len(modes), -1))
    return np.asarray(root.T @ root + deviation**2 * np.eye(root.shape[1]))


class Pieces:
    """The free parts of a map.

    Args:
        slots: (p,) number of the part that each landmark belongs to, from 0 on; -1: known.
        rigid: whether parts are bodies that turn, or single points.
    """

    def __init__(self, slots: IntArray, rigid: bool) -> None:
        self.slots, self.rigid, self.width = slots, rigid, BODY if rigid else PLACE
        self.count = int(slots.max(initial=-1)) + 1

    @property
    def columns(self) -> int:
        """How many numbers are free."""
        return self.width * self.count

    def centres(self, landmarks: Array) -> Array:
        """Return the middles (c,3) of the parts of landmarks (p,3)."""
        free = self.slots >= 0
        members = np.bincount(self.slots[free], minlength=self.count)
        sums = [np.bincount(self.slots[free], of, self.count) for of in landmarks[free].T]
        return np.column_stack(sums) / members[:, None]

    def arms(self, landmarks: Array) -> Array:
        """Return vectors (p,3) from the middle of its part to each landmark; zeros where known."""
        arms = np.zeros_like(landmarks)
        if self.rigid:
            free = self.slots >= 0
            arms[free] = landmarks[free] - self.centres(landmarks)[self.slots[free]]
        return arms

    def moved(self, landmarks: Array, step: Array) -> Array:
        """Return the landmarks (p,3) after a step (columns,)."""
        step, free = step.reshape(-1, self.width), self.slots >= 0
        moved, own = landmarks.copy(), self.slots[free]
        moved[free] += step[own, :PLACE]
        if self.rigid:
            turns, arms = so3.exp_many(step[:, PLACE:]), self.arms(landmarks)[free]
            moved[free] += np.einsum("nij,nj->ni", turns[own], arms) - arms
        return moved
