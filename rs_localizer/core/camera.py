# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Camera: raw pixels to bearings and row times, and back.

A raw pixel is a pixel of the driver's image: distorted, with the centre of the first pixel at (0,
0), possibly binned and cropped. Its bearing comes from the undistorted position, its row time from
the raw row of the full sensor: distortion moves light between rows, not rows in time.
"""

from __future__ import annotations

import math
import reprlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from functools import lru_cache
from numbers import Integral, Real
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core import lens_laws
from rs_localizer.core.arrays import Array, instance, real
from rs_localizer.core.double_sphere import DOUBLE_SPHERE
from rs_localizer.core.equidistant import EQUIDISTANT
from rs_localizer.core.eucm import EUCM
from rs_localizer.core.lens_laws import LensLaw, Sphere
from rs_localizer.core.scanning import ScanDirection

# NumPy's ArrayLike is so wide that type checkers take [[500, 0], [0, 500]] for a list of objects.
Matrix = NDArray[Any] | Sequence[Sequence[float]]
Vector = NDArray[Any] | Sequence[float]

E = TypeVar("E", bound=StrEnum)


def numbers(name: str, values: Any, take: Callable[..., Array] = np.array) -> Array:
    """Return a float64 array of the values, new by default; ValueError for what is no number."""
    if np.ma.is_masked(values):
        raise ValueError(f"{name} must be finite, found masked values: leave out their rows")
    try:
        if values is not None:  # which NumPy takes for NaN
            return take(values, dtype=np.float64)
    except (TypeError, ValueError):
        pass
    raise ValueError(f"{name} must be numbers, got {reprlib.repr(values)}")


def pixel_count(name: str, value: Any) -> int:
    """Return a whole number of pixels, also of a float as in JSON (1280.0), or raise ValueError."""
    if isinstance(value, Real) and not isinstance(value, bool):
        number = float(value)
        if math.isfinite(number) and number == math.floor(number):
            return int(number)
    raise ValueError(f"{name} must be a whole number of pixels, got {value!r}")


def choice(name: str, kind: type[E], value: Any) -> E:
    """Return the member of an enumeration with this value; ValueError if there is none."""
    try:
        return kind(value)
    except ValueError:
        raise ValueError(f"{name} must be one of {', '.join(kind)}; got {value!r}") from None


class DistortionModel(StrEnum):
    """THE list of lenses: names in CameraInfo (the last two: Kalibr's), and their laws."""

    law: LensLaw

    # The default is for type checkers, which take a look-up by name for a call of this.
    def __new__(cls, name: str, law: LensLaw = lens_laws.PLUMB_BOB) -> Self:
        member = str.__new__(cls, name)
        member._value_ = name
        member.law = law
        return member

    PLUMB_BOB = "plumb_bob", lens_laws.PLUMB_BOB
    RATIONAL_POLYNOMIAL = "rational_polynomial", lens_laws.RATIONAL_POLYNOMIAL
    EQUIDISTANT = "equidistant", EQUIDISTANT
    EUCM = "eucm", EUCM
    DOUBLE_SPHERE = "ds", DOUBLE_SPHERE


_WIDEST = 2**16  # pixels: line-scan cameras have 16,384
_LONGEST_READOUT = 0.5  # s: more than any camera takes, also for a picture of a still world
# Pixels; a lens is neither a needle's eye nor a telescope of the next galaxy.
_LEAST_FOCAL, _MOST_FOCAL = 1e-3, 1e9
# A pixel that does not come back to itself has no bearing: it lies beyond the model's range.
_ROUND_TRIP_TOLERANCE = 1e-3


@dataclass(frozen=True, slots=True)
class Roi:
    """The part of the sensor that is delivered, in pixels of the full sensor."""

    x_offset: int
    y_offset: int
    width: int
    height: int

    def __post_init__(self) -> None:
        for name in ("x_offset", "y_offset", "width", "height"):
            object.__setattr__(self, name, pixel_count(f"roi.{name}", getattr(self, name)))


# A principal point is no farther from the middle, and beside it, as a share of width and height.
_CENTRAL, _BESIDE = 0.05, 0.1


def _check_exchanged(K: Array, width: int, height: int) -> None:
    """Refuse a principal point in the middle of an image with width and height exchanged."""
    off = np.abs(K[:2, 2] / [width, height] - 0.5)
    exchanged = np.abs(K[:2, 2] / [height, width] - 0.5)
    if np.all(off > _BESIDE) and np.all(exchanged < _CENTRAL):
        raise ValueError(
            f"the principal point ({K[0, 2]:g}, {K[1, 2]:g}) is in the middle of an image of "
            f"{height}x{width}, not of {width}x{height}: are width and height exchanged?"
        )


# A focal length of this many widths sees 6 degrees; in pixels nothing is as short.
_LONGEST_IN_WIDTHS = 10.0


def _check_unit(K: Array, width: int, height: int) -> None:
    """Refuse a camera matrix in widths and heights of the image (a normalized calibration)."""
    is_middle = np.all(np.abs(K[:2, 2] - 0.5) < _BESIDE)
    if is_middle and min(width, height) > 2 and max(K[0, 0], K[1, 1]) < _LONGEST_IN_WIDTHS:
        raise ValueError(
            f"K is in widths and heights of the image, not in pixels: focal lengths "
            f"{K[0, 0]:g}, {K[1, 1]:g}, principal point ({K[0, 2]:g}, {K[1, 2]:g}); multiply its "
            f"first row by {width} and its second by {height}"
        )


def _matrix(K: Any) -> Array:
    """Return a camera matrix (3,3), also of its nine numbers in the order of CameraInfo."""
    matrix = numbers("K", K)
    matrix = matrix.reshape(3, 3) if matrix.shape == (9,) else matrix
    if matrix.shape != (3, 3) or not np.all(np.isfinite(matrix)):
        raise ValueError(f"K must be a finite 3x3 matrix, got {matrix.tolist()}")
    return matrix


def _coefficients(D: Any, law: LensLaw) -> Array:
    """Return coefficients of distortion (k,); none, or zeros where the ideal lens is no pinhole."""
    given = np.zeros(0) if D is None else numbers("D", D).ravel()
    ideal = len(given) == 0 and law.sphere is not None and 0 in law.counts
    return np.zeros(law.counts[-1]) if ideal else given


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """A calibrated camera with its shutter.

    Args:
        width, height: size of the full sensor image to which K belongs, pixels.
        K: (3,3) intrinsic matrix without skew.
        D: distortion coefficients in OpenCV's order (empty or None: none); alpha, beta of
            ``eucm``, xi, alpha of ``ds``.
        distortion_model: ``plumb_bob``, ``rational_polynomial``, ``equidistant``, ``eucm`` or
            ``ds``; see :class:`DistortionModel`.
        readout_time: s from the first to the last row of the full sensor; 0 = unknown.
        scan_direction: see :class:`ScanDirection`.
        binning: sensor pixels per delivered pixel, (x, y).
        roi: the delivered part of the sensor; None = all.

    Raises:
        ValueError: for an uncalibrated or impossible camera, saying what was found.

    A delivered pixel ``p`` is ``p * binning + roi offset`` on the sensor, as in ROS'
    image_geometry.
    """

    width: int
    height: int
    K: Array
    D: Array = field(default_factory=lambda: np.zeros(0))
    distortion_model: str = DistortionModel.PLUMB_BOB
    readout_time: float = 0.0
    scan_direction: str = ScanDirection.TOP_TO_BOTTOM
    binning: tuple[int, int] = (1, 1)
    roi: Roi | None = None

    if TYPE_CHECKING:  # what may be given; the fields say what it becomes

        def __init__(
            self,
            width: int | float,
            height: int | float,
            K: Matrix,
            D: Vector | None = None,
            distortion_model: str = ...,
            readout_time: float = ...,
            scan_direction: str = ...,
            binning: tuple[int, int] = ...,
            roi: Roi | None = None,
        ) -> None: ...

    def __post_init__(self) -> None:
        set_field = object.__setattr__  # the dataclass is frozen; this is its constructor
        K = _matrix(self.K)
        set_field(self, "width", pixel_count("width", self.width))
        set_field(self, "height", pixel_count("height", self.height))
        if K[0, 0] <= 0.0 or K[1, 1] <= 0.0:
            raise ValueError(
                f"the camera is not calibrated: focal lengths are {K[0, 0]:g}, {K[1, 1]:g}"
            )
        if K[0, 1] != 0.0 or K[1, 0] != 0.0 or np.any(K[2] != (0.0, 0.0, 1.0)):
            raise ValueError(f"K must have no skew and a last row 0 0 1, got {K.tolist()}")
        model = choice("distortion_model", DistortionModel, self.distortion_model)
        D = _coefficients(self.D, model.law)
        if len(D) not in model.law.counts:
            raise ValueError(
                f"{model} takes {' or '.join(map(str, model.law.counts))} coefficients, "
                f"got {len(D)}"
            )
        if not np.all(np.isfinite(D)):
            raise ValueError(f"D must be finite, got {D.tolist()}")
        for value, (low, high) in zip(D, model.law.limits or (), strict=False):
            if not low <= value <= high:
                raise ValueError(
                    f"D of {model} must lie within {model.law.limits}, got {D.tolist()}"
                )
        direction = choice("scan_direction", ScanDirection, self.scan_direction)
        if min(self.width, self.height) < 2 or max(self.width, self.height) > _WIDEST:
            raise ValueError(
                f"the image must be at least 2x2 and at most {_WIDEST} pixels wide and high, got "
                f"{self.width}x{self.height}"
            )
        real("readout_time", self.readout_time, "0 or more seconds", 0.0)
        object.__setattr__(self, "readout_time", float(self.readout_time))
        if self.readout_time > _LONGEST_READOUT:
            raise ValueError(
                f"readout_time must be at most {_LONGEST_READOUT:g} s, got {self.readout_time:g}: "
                f"it is in seconds; {self.readout_time:g} ms are {1e-3 * self.readout_time:g}"
            )
        steps = self.binning if np.ndim(self.binning) == 1 else ()
        if len(steps) != 2 or not all(isinstance(step, Integral) and step > 0 for step in steps):
            raise ValueError(f"binning must be two numbers of 1 or more, got {self.binning}")
        if not (_LEAST_FOCAL < K[0, 0] < _MOST_FOCAL and _LEAST_FOCAL < K[1, 1] < _MOST_FOCAL):
            raise ValueError(f"focal lengths of {K[0, 0]:g}, {K[1, 1]:g} pixels are impossible")
        if (roi := self.roi) is not None:
            instance("roi", roi, Roi)
        if roi is not None and (
            min(roi.width, roi.height) < 1
            or min(roi.x_offset, roi.y_offset) < 0
            or roi.x_offset + roi.width > self.width
            or roi.y_offset + roi.height > self.height
        ):
            raise ValueError(f"{roi} does not lie on a sensor of {self.width}x{self.height}")
        if roi is None:
            _check_exchanged(K, self.width, self.height)
        _check_unit(K, self.width, self.height)
        for array in (K, D):
            array.flags.writeable = False
        set_field(self, "K", K)
        set_field(self, "D", D)
        set_field(self, "distortion_model", model)
        set_field(self, "scan_direction", direction)

    # -- row time ---------------------------------------------------------------------------

    def row_time(self, pixels: Array) -> Array:
        """Return row times (n,) of raw pixels (n,2): -0.5 at the first row, 0.5 at the last."""
        first, gradient = _rows_of(self)
        return first + np.asarray(pixels, float) @ gradient

    @property
    def row_time_gradient(self) -> Array:
        """Derivative (2,) of the row time by the raw pixel, per delivered pixel."""
        return _rows_of(self)[1]

    @property
    def first_row_time(self) -> float:
        """Row time of the first exposed row of the delivered image (-0.5 without a ROI)."""
        axis, sign, size = self._scan()
        if self.roi is None:
            return -0.5
        offset, extent = (
            (self.roi.x_offset, self.roi.width),
            (self.roi.y_offset, self.roi.height),
        )[axis]
        first = offset if sign > 0 else offset + extent - 1
        return float(sign * (first - 0.5 * (size - 1)) / (size - 1))

    def _scan(self) -> tuple[int, int, int]:
        """Return the pixel axis of the shutter's motion, its sign, and the sensor's size on it."""
        columns = self.scan_direction in (ScanDirection.LEFT_TO_RIGHT, ScanDirection.RIGHT_TO_LEFT)
        forward = self.scan_direction in (ScanDirection.TOP_TO_BOTTOM, ScanDirection.LEFT_TO_RIGHT)
        return (
            (0, 1 if forward else -1, self.width)
            if columns
            else (1, 1 if forward else -1, self.height)
        )

    def _offset(self) -> Array:
        if self.roi is None:
            return np.zeros(2)
        return np.array([self.roi.x_offset, self.roi.y_offset], dtype=np.float64)

    # -- bearing ----------------------------------------------------------------------------

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the delivered image, in delivered pixels."""
        width, height = (
            (self.width, self.height) if self.roi is None else (self.roi.width, self.roi.height)
        )
        return width // self.binning[0], height // self.binning[1]

    @property
    def focal_length(self) -> float:
        """Geometric mean of the two focal lengths, in delivered pixels."""
        K, binning = self.K, self.binning
        return math.sqrt(K[0, 0] / binning[0] * K[1, 1] / binning[1])

    def rays(self, pixels: Array) -> Array:
        """Return the undistorted bearings (n,2), ``x/z, y/z``, of raw pixels (n,2).

        NaN where the distortion model has no bearing for the pixel.
        """
        return self.rays_and_jacobian(pixels)[0]

    def rays_and_jacobian(self, pixels: Array) -> tuple[Array, Array]:
        """Return bearings (n,2) as :meth:`rays`, and derivatives (n,2,2) of the pixels by them."""
        pixels = np.ascontiguousarray(pixels, dtype=np.float64)
        sensor = pixels * self.binning + self._offset()
        if len(self.D) == 0 or len(sensor) == 0:
            plain: Array = (sensor - self.K[:2, 2]) / (self.K[0, 0], self.K[1, 1])
            return plain, self.pixel_jacobian(plain)
        usable = np.isfinite(sensor[:, 0]) & np.isfinite(sensor[:, 1])
        if usable.all():
            rays = self.law.undistort(sensor, self.K, self.D)
        else:
            rays = np.full(sensor.shape, np.nan)
            if usable.any():
                rays[usable] = self.law.undistort(sensor[usable], self.K, self.D)
        back, jacobian = self.distort(rays)
        near = np.abs(back - pixels) < _ROUND_TRIP_TOLERANCE
        rays[~(near[:, 0] & near[:, 1])] = np.nan
        return rays, jacobian

    def project(self, points: Array) -> Array:
        """Return raw pixels (n,2) of points (n,3) in the camera frame; NaN if the lens sees none.

        Lenses of more than 180 degrees see what lies behind the image plane.
        """
        points = np.asarray(points, float)
        if (sphere := self._sphere) is not None:
            sensor = sphere.project(points, self.K, self.D).pixels
            return np.asarray((sensor - self._offset()) / self.binning)
        depth = np.where(points[:, 2] > 0.0, points[:, 2], np.nan)
        return self.distort(points[:, :2] / depth[:, None])[0]

    def bearings(self, pixels: Array) -> Array:
        """Return unit vectors (n,3) from the camera through raw pixels (n,2); NaN if there is none.

        Unlike :meth:`rays`, also of what lies behind the image plane.
        """
        pixels = np.asarray(pixels, float)
        if (sphere := self._sphere) is None:
            towards = np.column_stack([self.rays(pixels), np.ones(len(pixels))])
        else:
            sensor = pixels * self.binning + self._offset()
            towards = sphere.find_bearings((sensor - self.K[:2, 2]) / np.diag(self.K)[:2], self.D)
            lost = ~(np.abs(self.project(towards) - pixels) < _ROUND_TRIP_TOLERANCE).all(axis=1)
            towards[lost] = np.nan
        return np.asarray(towards / np.linalg.norm(towards, axis=1, keepdims=True))

    @property
    def sees_behind(self) -> bool:
        """True if some of the image shows what lies behind the image plane."""
        if self._sphere is None:
            return False
        # All over the image: its corners may show nothing, the middle of a side nothing behind.
        places = np.meshgrid(*(np.linspace(0.0, size - 1.0, 33) for size in self.size))
        pixels = np.column_stack([each.ravel() for each in places])
        return bool(np.any(self.bearings(pixels)[:, 2] <= 0.0))  # NaN compares false

    @property
    def _sphere(self) -> Sphere | None:
        return self.law.sphere if len(self.D) else None

    def pixel_jacobian(self, rays: Array) -> Array:
        """Return the derivatives (n,2,2) of the raw pixel by the ray at rays (n,2)."""
        return self.distort(np.asarray(rays, float))[1]

    def inside(self, pixels: Array) -> NDArray[np.bool_]:
        """Return a mask (n,) of the raw pixels (n,2) that lie in the delivered image."""
        limit = np.array(self.size) - 0.5
        inside: NDArray[np.bool_] = np.all((pixels > -0.5) & (pixels < limit), axis=1)
        return inside  # NaN compares false

    @property
    def law(self) -> LensLaw:
        """How the lens bends bearings."""
        return DistortionModel(self.distortion_model).law

    def distort(self, rays: Array) -> tuple[Array, Array]:
        """Return the raw pixels (n,2) of rays (n,2), and their derivatives (n,2,2) by the ray."""
        count = len(rays)
        if len(self.D) == 0 or count == 0:
            focal = np.array([self.K[0, 0], self.K[1, 1]])
            sensor = rays * focal + self.K[:2, 2]
            jacobian = np.broadcast_to(np.diag(focal), (count, 2, 2))
        else:
            sensor, jacobian, *_ = self.law.project(rays, self.K, self.D)
        pixels: Array = (sensor - self._offset()) / self.binning
        return pixels, np.ascontiguousarray(jacobian / np.array(self.binning)[:, None])


@lru_cache(64)  # of the cameras of a rig, and lenses that are tried
def _rows_of(camera: Camera) -> tuple[float, Array]:
    """Return the row time of the first pixel, and its derivative (2,) by the pixel."""
    axis, sign, size = camera._scan()
    gradient = np.zeros(2)
    gradient[axis] = sign * camera.binning[axis] / (size - 1)
    gradient.flags.writeable = False
    return float(sign * (camera._offset()[axis] - 0.5 * (size - 1)) / (size - 1)), gradient
