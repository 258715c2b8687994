# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Rigs: several cameras that move as one, each with a shutter and a clock of its own.

In a row that is exposed at ``t``, camera ``k`` of a rig sees a point of the map at

    X_camera = R_k (rig_from_map(t) X_map) + p_k

When the rig rotates, ``p_k`` is the lever arm that moves the camera. A single camera is a rig with
``R = I`` and ``p = 0``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rs_localizer.core.arrays import Array, Array2, Array3, IntArray, instance
from rs_localizer.core.bearings import bearings, projected
from rs_localizer.core.camera import Camera, numbers
from rs_localizer.core.types import Estimate

# Entries of R R^T - I beyond this are no rounding of a calibration file's digits.
_ORTHONORMAL = 1e-3
# s; exposures that are farther apart are not one frame: no motion stays smooth for so long.
_LONGEST_SPAN = 2.0

Extrinsics = tuple[Any, Any]
"""Rotation (3,3) and translation (3,), ``X_camera = R X_rig + t``."""


@dataclass(frozen=True, slots=True, eq=False)
class Rig:
    """Cameras that are mounted to one body.

    Args:
        cameras: by their names, each with its shutter.
        camera_from_rig: rotation (3,3) and translation (3,) m of each camera, with ``X_camera = R
            X_rig + t``. Put the rig's origin near the cameras: the prior of the velocity holds for
            this point.
        time_offset: s to add to the stamps of a camera; absent: 0.

    Raises:
        ValueError: a name is unknown or missing, a matrix is no rotation, a value is not finite, or
            one of several cameras has no readout time.
    """

    cameras: Mapping[str, Camera]
    camera_from_rig: Mapping[str, tuple[Array, Array]]
    time_offset: Mapping[str, float] = field(default_factory=dict)

    if TYPE_CHECKING:  # the types that callers may pass; the fields have the types that are kept

        def __init__(
            self,
            cameras: Mapping[str, Camera],
            camera_from_rig: Mapping[str, Extrinsics],
            time_offset: Mapping[str, float] = ...,
        ) -> None: ...

    def __post_init__(self) -> None:
        if not isinstance(self.cameras, Mapping) or not self.cameras:
            raise ValueError(f"cameras must be {{name: camera}}, got {self.cameras!r}")
        for name, camera in self.cameras.items():
            if not isinstance(name, str):
                raise ValueError(f"cameras have names, got {name!r}")
            instance(f"cameras[{name!r}]", camera, Camera)
            if len(self.cameras) > 1 and not camera.readout_time > 0.0:
                raise ValueError(f"{name}: a camera of a rig needs its readout_time, which is 0")
        for given, values in (
            ("camera_from_rig", self.camera_from_rig), ("time_offset", self.time_offset),
        ):  # fmt: skip
            if not isinstance(values, Mapping):
                raise ValueError(f"{given} must be a mapping by names, got {values!r}")
            unknown = [name for name in values if name not in self.cameras]
            if unknown:
                raise ValueError(
                    f"{given} has {', '.join(map(repr, unknown))}; the cameras are "
                    f"{', '.join(map(repr, self.cameras))}"
                )
        missing = [name for name in self.cameras if name not in self.camera_from_rig]
        if missing:
            raise ValueError(f"camera_from_rig lacks {', '.join(map(repr, missing))}")
        extrinsics = {name: _extrinsics(name, self.camera_from_rig[name]) for name in self.cameras}
        offsets = {name: _seconds(name, self.time_offset.get(name, 0.0)) for name in self.cameras}
        set_field = object.__setattr__
        set_field(self, "cameras", MappingProxyType(dict(self.cameras)))
        set_field(self, "camera_from_rig", MappingProxyType(extrinsics))
        set_field(self, "time_offset", MappingProxyType(offsets))

    def __reduce__(self) -> tuple[Any, ...]:  # a MappingProxyType cannot be pickled
        return Rig, (dict(self.cameras), dict(self.camera_from_rig), dict(self.time_offset))

    @classmethod
    def of(cls, camera: Camera) -> Rig:
        """Return a rig of one camera, with the camera's axes."""
        return cls({"camera": camera}, {"camera": (np.eye(3), np.zeros(3))})

    @property
    def focal_length(self) -> float:
        """Mean of the cameras' focal lengths, in their delivered pixels."""
        return sum(camera.focal_length for camera in self.cameras.values()) / len(self.cameras)

    def exposure(
        self, names: Sequence[str] | None = None, stamps: Mapping[str, float] | None = None
    ) -> Exposure:
        """Return the times and places from which some of the cameras see a frame.

        Args:
            names: of the cameras that have a part in it; None: all.
            stamps: s, exposure of their first delivered rows, relative to anything; None: all 0.

        Raises:
            ValueError: an unknown or missing name, a stamp that is not finite, or exposures that
                are more than 2 s apart.
        """
        chosen = tuple(self.cameras if names is None else names)
        given = dict.fromkeys(chosen, 0.0) if stamps is None else stamps
        for name in chosen:
            if name not in self.cameras:
                raise ValueError(f"the rig has no camera {name!r}, but {', '.join(self.cameras)}")
            if name not in given:
                raise ValueError(f"stamps lack {name!r}")
        cameras = tuple(self.cameras[name] for name in chosen)
        readouts = np.array([camera.readout_time for camera in cameras])
        starts = np.array([_seconds(name, given[name]) for name in chosen])
        offsets = np.array([self.time_offset[name] for name in chosen])
        rows = np.array([camera.first_row_time for camera in cameras])
        # Relative to the first one, because seconds since 1970 use up a double's digits.
        middles = (starts - starts[0]) + offsets - rows * readouts
        reference = middles[0]
        middles -= reference
        first, last = np.min(middles - 0.5 * readouts), np.max(middles + 0.5 * readouts)
        span, middle = float(last - first), 0.5 * float(first + last)
        if not span <= max(_LONGEST_SPAN, *readouts):
            raise ValueError(
                f"the exposures of a frame are {span:.3g} s apart: stamps are in seconds, of one "
                "frame, and by one clock but for time_offset"
            )
        sides = tuple(
            Side(camera, place, axes)
            for place, camera in enumerate(cameras)
            for axes in _sides_of(camera)
        )
        axes = np.array([self.camera_from_rig[name][0] for name in chosen])
        moved = np.array([self.camera_from_rig[name][1] for name in chosen])
        centres, of = -np.einsum("kji,kj->ki", axes, moved), [side.place for side in sides]
        per_span = readouts / span if span > 0.0 else np.ones(len(chosen))
        gradients = np.array([camera.row_time_gradient for camera in cameras]) * per_span[:, None]
        return Exposure(
            chosen,
            cameras,
            float(starts[0] + (reference + middle)),
            span,
            per_span,
            (middles - middle) / span if span > 0.0 else np.zeros(len(chosen)),
            sides,
            Mounts(
                np.array([side.turned(axes[side.place]) for side in sides]),
                centres[of],
                gradients[of],
            ),
        )


def _extrinsics(name: str, given: Any) -> tuple[Array, Array]:
    try:
        rotation, translation = (numbers(f"camera_from_rig[{name!r}]", each) for each in given)
    except (TypeError, ValueError):
        rotation = translation = np.zeros(0)
    shapes = rotation.shape == (3, 3) and translation.shape == (3,)
    if not (shapes and np.all(np.isfinite(rotation)) and np.all(np.isfinite(translation))):
        raise ValueError(
            f"camera_from_rig[{name!r}] must be a rotation and a translation of finite numbers, "
            f"(3,3) and (3,), got {given!r}"
        )
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > _ORTHONORMAL or np.linalg.det(rotation) < 0.0:
        raise ValueError(
            f"camera_from_rig[{name!r}] has no rotation: R R^T is off by {off:.2g}, det R is "
            f"{np.linalg.det(rotation):.3g}"
        )
    if off > 0.0:  # the nearest rotation
        left, _, right = np.linalg.svd(rotation)
        rotation = left @ right
    for array in (rotation, translation):
        array.flags.writeable = False
    return rotation, translation


def _seconds(name: str, value: Any) -> float:
    seconds = numbers(f"time of {name}", value)
    if seconds.shape != () or not np.isfinite(seconds):
        raise ValueError(f"times of {name} must be finite seconds, got {value!r}")
    return float(seconds)


# Camera axes of the sides of a cube about a camera: ahead, behind, and along x and y.
_CUBE = np.array([
    [[1, 0, 0], [0, 1, 0], [0, 0, 1]], [[-1, 0, 0], [0, 1, 0], [0, 0, -1]],
    [[0, 1, 0], [0, 0, 1], [1, 0, 0]], [[0, 0, 1], [0, 1, 0], [-1, 0, 0]],
    [[0, 0, 1], [1, 0, 0], [0, 1, 0]], [[1, 0, 0], [0, 0, 1], [0, -1, 0]],
], float)  # fmt: skip


@lru_cache(64)
def _sides_of(camera: Camera) -> tuple[Array | None, ...]:
    return tuple(_CUBE) if camera.sees_behind else (None,)


class Side(NamedTuple):
    """View of a camera about one axis, as a camera of its own that looks there.

    Rays ``x/z, y/z`` are infinite at 90 degrees from the axis. So a lens that sees behind its image
    plane is treated as six cameras at one place, each of which sees less than 55 degrees.
    """

    camera: Camera
    place: int  # of the camera in the frame
    axes: Array | None  # (3,3) side_from_camera; None: all that the camera sees, in its axes

    def turned(self, camera_from_rig: Array) -> Array:
        """Return the rotation (3,3) side_from_rig."""
        return camera_from_rig if self.axes is None else self.axes @ camera_from_rig

    def towards(self, rays: Array) -> Array:
        """Return bearings (n,3), camera axes, of rays (n,2); the rays, if this side sees all."""
        if self.axes is None:
            return rays
        towards: Array = np.column_stack([rays, np.ones(len(rays))]) @ self.axes
        return towards

    def pixel_jacobian(self, rays: Array) -> Array:
        """Return the derivatives (n,2,2) of the raw pixel by rays (n,2) of this side."""
        if self.axes is None:
            return projected(self.camera, rays)[1]
        camera = self.camera
        by_bearing = camera.law.project_towards(self.towards(rays), camera.K, camera.D).by_ray
        by_ray: Array = by_bearing @ self.axes[:2].T / np.array(camera.binning)[:, None]
        return by_ray


class Mounts(NamedTuple):
    """Mounting of the k sides of a frame's cameras to the rig, and the way their shutters run."""

    axes: Array3  # (k,3,3) side_from_rig
    centres: Array2  # (k,3) m, of the cameras in the rig
    gradients: Array2  # (k,2) of the row time by the pixel

    @classmethod
    def one(cls, gradient: Array) -> Mounts:
        """Return the mounts of a single camera."""
        return cls(np.eye(3)[None], np.zeros((1, 3)), np.asarray(gradient, float)[None])


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """Times at which the k cameras of a frame are exposed, and their places on the rig.

    Row times of a frame are counted from the middle of all exposures, in the span from the first
    exposed row of any camera to the last one: from -0.5 to 0.5.
    """

    names: tuple[str, ...]
    cameras: tuple[Camera, ...]
    time: float  # s, middle of all exposures, by the clock of the stamps
    span: float  # s; 0: the readout time of a camera alone is unknown
    readouts: Array  # (k,) in spans
    middles: Array  # (k,) row times of their middle rows
    sides: tuple[Side, ...]  # of all cameras, one after the other
    mounts: Mounts  # of the sides

    @property
    def alone(self) -> bool:
        """True if one camera sees the frame."""
        return len(self.cameras) == 1

    @property
    def lenses(self) -> IntArray | None:
        """Return the place of the camera of each side (k,); None if there is only one camera."""
        return None if self.alone else np.array([side.place for side in self.sides])

    def ahead(self, pixels: Array | None = None) -> Exposure:
        """Return the exposure of a single camera that sees only what lies before its image plane.

        Args:
            pixels: (n,2) raw; if one of them shows more than that, the exposure is unchanged.
        """
        if len(self.sides) == 1:
            return self
        if pixels is not None and np.any(self.cameras[0].bearings(pixels)[:, 2] <= 0.0):
            return self
        first = Mounts(*(values[:1] for values in self.mounts))
        return replace(self, sides=(Side(self.cameras[0], 0, None),), mounts=first)

    def look(self, place: int, pixels: Array) -> tuple[Array, Array, IntArray]:
        """Return rays (n,2) of a camera's raw pixels (n,2), their derivatives, and their sides.

        Rays are NaN if a pixel has none. The derivatives (n,2,2) are of the pixels by the rays.
        The sides (n,) are places in ``sides``.
        """
        if len(self.sides) == len(self.cameras):  # one for each
            return *bearings(self.cameras[place], pixels), np.full(len(pixels), place)
        own = [i for i, side in enumerate(self.sides) if side.place == place]
        if len(own) == 1:
            return *bearings(self.cameras[place], pixels), np.full(len(pixels), own[0])
        towards = self.cameras[place].bearings(pixels)
        chosen = np.argmax(towards @ _CUBE[:, 2].T, axis=1)
        local = np.einsum("nij,nj->ni", _CUBE[chosen], towards)
        rays, by_ray = local[:, :2] / local[:, 2:], np.empty((len(pixels), 2, 2))
        for number, i in enumerate(own):
            here = chosen == number
            by_ray[here] = self.sides[i].pixel_jacobian(rays[here])
        return rays, by_ray, chosen + own[0]

    def row_time(self, place: int, pixels: Array) -> Array:
        """Return the row times (n,) of raw pixels (n,2) of a camera."""
        rows = self.cameras[place].row_time(pixels)
        times: Array = rows * self.readouts[place] + self.middles[place]
        return times

    def by(self, camera: Camera) -> Exposure:
        """Return the exposure of a single camera through another lens."""
        sides = tuple(side._replace(camera=camera) for side in self.sides)
        return replace(self, cameras=(camera,), sides=sides)


class ByCamera(np.ndarray[Any, Any]):
    """Values of all points of a frame; ``values["front"]`` are those of one camera."""

    _places: Mapping[str, slice]

    @classmethod
    def of(cls, values: Array, places: Mapping[str, slice]) -> ByCamera:
        """Split values (n,) of all cameras at the places of each camera."""
        split = np.asarray(values).view(cls)
        split._places = places
        return split

    def like(self, values: Array) -> ByCamera:
        """Return other values (n,) of the same points, split by camera as these are."""
        return ByCamera.of(values, self._places)

    def __array_finalize__(self, source: Any) -> None:
        self._places = getattr(source, "_places", {})

    def __reduce__(self) -> tuple[Any, ...]:  # pickling an array drops its attributes
        return ByCamera.of, (np.array(self), self._places)

    def __deepcopy__(self, memo: object) -> ByCamera:
        return self.copy()

    def __getitem__(self, key: Any) -> Any:
        plain = self.view(np.ndarray)
        return plain[self._places[key]] if isinstance(key, str) else plain[key]


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class RigEstimate(Estimate):
    """An accepted pose and velocity of a rig; true in a condition.

    It is an :class:`Estimate` of the rig instead of the camera: rig_from_map at ``time``,
    velocities per ``span``. ``inliers`` and ``residuals`` hold the points of all cameras, one after
    the other; ``inliers["front"]`` are those of one camera.
    """

    time: float = 0.0  # s, middle of all exposures, by the clock of the stamps
    names: tuple[str, ...] = ()  # of the cameras that had a part, in the order of the points

    @classmethod
    def of(cls, estimate: Estimate, exposure: Exposure, counts: Sequence[int]) -> RigEstimate:
        """Return the estimate of a frame of a rig; ``counts`` are the points of each camera."""
        ends = np.cumsum(counts).tolist()
        places = {
            name: slice(end - count, end)
            for name, count, end in zip(exposure.names, counts, ends, strict=True)
        }
        values = {each.name: getattr(estimate, each.name) for each in fields(Estimate)}
        for name in ("inliers", "residuals"):
            values[name] = ByCamera.of(values[name], places)
        return cls(**values, time=exposure.time, names=exposure.names)

    def at_time(self, time: float) -> RigEstimate:
        """Return the motion at a time (s, clock of the stamps), with its covariance then."""
        # By the class: super() fails in a dataclass with slots.
        moved = Estimate.at_time(self, time - self.time)
        assert isinstance(moved, RigEstimate)
        return replace(moved, time=time)
