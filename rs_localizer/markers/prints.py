# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Prints that can be seen: single markers, and boards of squares, in the map frame.

The frame of a print has its origin in the middle of a marker's black square, or of a board's whole
pattern of squares. Its x points to the right, y up, and z out of the paper towards the viewer.
Corners of a marker are in OpenCV's order: top left, top right, bottom right, bottom left of the
upright print seen from its front. Corners of boards go row by row from the top left one.
"""

from dataclasses import KW_ONLY, dataclass, field, replace
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from rs_localizer.core.arrays import Array
from rs_localizer.io.transforms import from_numbers
from rs_localizer.markers.families import Family, family

# Corners that were measured are no exact square. Their largest distance from one, in sides.
_SQUARE_TOLERANCE = 0.05
# No camera sees more.
_MOST_SQUARES = 200
# Corners of a printed board whose shape was not measured are off by this share of their distance
# from the middle: 0.2 mm in 10 cm, as paper on a wall or a clipboard bends.
_PAPER = 0.002

# m: what is longer was given in millimetres.
_LONGEST = 10.0

_UNIT_SQUARE = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])
_ROTATION_TOLERANCE = 1e-3
# Two digits after the point are within this; what is farther from 1 was mistyped, or is no
# quaternion, and normalizing would make a wrong rotation of it.
_LENGTH_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """Pose of a print: map_from_print.

    Raises:
        ValueError: for a mirrored or no rotation, or values that are not finite.
    """

    position: Array = field(default_factory=lambda: np.zeros(3))  # (3,) m, of its middle
    rotation: Array = field(default_factory=lambda: np.eye(3))  # (3,3)

    def __post_init__(self) -> None:
        position = finite(self.position, (3,), "position")
        rotation = finite(self.rotation, (3, 3), "rotation")
        error = np.abs(rotation @ rotation.T - np.eye(3)).max()
        if error > _ROTATION_TOLERANCE:
            raise ValueError(f"rotation is not a rotation matrix: its rows are {rotation.tolist()}")
        if np.linalg.det(rotation) < 0.0:
            raise ValueError(
                "the rotation mirrors (its determinant is -1): x is to the right, y up and z out "
                "of the print"
            )
        object.__setattr__(self, "position", position)
        object.__setattr__(self, "rotation", rotation)

    def __call__(self, points: Array) -> Array:
        """Transform points (n,3) of the print to the map frame."""
        return np.asarray(points @ self.rotation.T + self.position)


def rotation_of_quaternion(quaternion: ArrayLike) -> Array:
    """Return the rotation matrix (3,3) of ``x y z w``, of unit length up to rounding.

    Raises:
        ValueError: for anything but four finite values of that length.
    """
    q = finite(quaternion, (4,), "quaternion (x, y, z, w)")
    length = float(np.linalg.norm(q))
    if abs(length - 1.0) > _LENGTH_TOLERANCE:
        raise ValueError(f"the quaternion (x y z w) must have the length 1, found {length:.4g}")
    x, y, z, w = q / length
    return from_numbers((0.0, 0.0, 0.0), (x, y, z, w)).rotation


def finite(values: ArrayLike, shape: tuple[int, ...], name: str) -> Array:
    """Return the values as an array of this shape, or raise a ``ValueError`` that names them."""
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, found {values!r}") from None
    if array.shape != shape:
        wanted = " x ".join(map(str, shape))
        raise ValueError(f"{name} must have {wanted} values, found the shape {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"{name} must be finite, found {array.tolist()}")
    return array


@dataclass(frozen=True, slots=True, eq=False)
class Marker:
    """A single marker by its corners; :meth:`at` makes one of a pose and a size.

    Raises:
        ValueError: for an id that the family does not have, or corners that are no square.
    """

    family: Family
    id: int
    corners: Array  # (4,3) m, map frame
    # (6,) standard deviations of place (m) and turn (rad) along the map's axes, where it was
    # surveyed.
    deviations: Array | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.id < self.family.count:
            raise ValueError(
                f"{self.family.name} has the ids 0 to {self.family.count - 1}, found {self.id}"
            )
        object.__setattr__(self, "corners", finite(self.corners, (4, 3), "corners"))
        _square_pose(self.corners)
        if self.deviations is not None:
            object.__setattr__(self, "deviations", finite(self.deviations, (6,), "deviations"))
            if np.any(self.deviations < 0.0):
                raise ValueError(f"deviations must not be negative: {self.deviations.tolist()}")

    @classmethod
    def at(cls, family_name: str, id_: int, size: float, pose: Pose | None = None) -> Self:
        """Return a square marker; ``size`` (m) is the side of its black square, without the rim."""
        _positive(size, "size")
        return cls(family(family_name), id_, (pose or Pose())(size * _UNIT_SQUARE))

    @property
    def size(self) -> float:
        """Mean side, m."""
        return _side(self.corners)

    @property
    def pose(self) -> Pose:
        """Pose of the square that best fits the four corners."""
        return _square_pose(self.corners)

    @property
    def points(self) -> Array:
        """The corners (4,3)."""
        return self.corners

    @property
    def name(self) -> str:
        return f"marker {self.family.name} {self.id}"


@dataclass(frozen=True, slots=True, eq=False)
class _Board:
    """Points in rows, in one plane or nearly."""

    columns: int
    rows: int
    _: KW_ONLY
    pose: Pose = field(default_factory=Pose)
    shape: Array | None = None  # (n,3) m, how far from flat each point is, in the print's axes
    deviation: float | None = None  # m, of the points' places as they are given; None: paper's

    @property
    def flat(self) -> Array:
        """Points (n,3) in the print's axes, row by row, of a board that is flat."""
        raise NotImplementedError

    @property
    def points(self) -> Array:
        """Points (n,3) in the map, row by row."""
        return self.pose(self.flat if self.shape is None else self.flat + self.shape)

    @property
    def points_deviation(self) -> float:
        """Deviation of the points (m, rms of one standard deviation): as given, or paper's."""
        if self.deviation is not None:
            return self.deviation
        apart = self.points - self.points.mean(axis=0)
        return _PAPER * float(np.sqrt(np.mean(np.sum(apart**2, axis=1))))

    def with_points(self, points: Array, deviation: float | None = None) -> Self:
        """Return the board with its points at (n,3) in the map, known to a deviation (m)."""
        shape = (points - self.pose(self.flat)) @ self.pose.rotation
        return replace(self, shape=shape, deviation=deviation)

    def _check(self, least: tuple[int, int], wanted: str, *lengths: str) -> None:
        """Raise ValueError for a board of unusable size, lengths (names of fields, m) or shape."""
        size = f"{self.columns}x{self.rows}"
        if self.columns < least[0] or self.rows < least[1]:
            raise ValueError(f"{wanted}, got {size}")
        if max(self.columns, self.rows) > _MOST_SQUARES:
            raise ValueError(f"a board may be {_MOST_SQUARES} squares wide and high, got {size}")
        for name in lengths:
            _positive(getattr(self, name), name)
        if self.shape is not None:
            object.__setattr__(self, "shape", finite(self.shape, self.flat.shape, "shape"))
        if self.deviation is not None and not 0.0 <= self.deviation < np.inf:
            raise ValueError(f"deviation must be 0 or more metres, found {self.deviation!r}")


@dataclass(frozen=True, slots=True, eq=False)
class Chessboard(_Board):
    """A chessboard by its inner corners, of which ``columns`` are in a row.

    It looks the same turned by half (a square one by a quarter, too): which corner is the first
    is only known when columns + rows is odd, from the color of the square beyond it.
    """

    square: float  # m

    def __post_init__(self) -> None:
        self._check((3, 3), "a board needs 3x3 inner corners", "square")  # OpenCV's own limit

    @property
    def flat(self) -> Array:
        return flat_grid(self.columns, self.rows, self.square)

    @property
    def name(self) -> str:
        return f"chessboard {self.columns}x{self.rows}"


@dataclass(frozen=True, slots=True, eq=False)
class Charuco(_Board):
    """A chessboard with a marker in each of its white squares: seen in part, it is known, too.

    ``columns`` are squares along a row; the points are inner corners of the squares. Markers have
    ids from ``first_id`` on, row by row from the top left. The top left square is black; with
    ``legacy`` (OpenCV before 4.6) it is white when the number of rows is even.
    """

    square: float  # m
    marker: float  # m, side of the black square of a marker
    family: Family
    first_id: int = 0
    legacy: bool = False

    def __post_init__(self) -> None:
        least = (2, 3) if self.rows > 2 else (3, 2)
        self._check(least, "a ChArUco board needs 2x3 squares or more", "square", "marker")
        if self.marker >= self.square:
            raise ValueError(
                f"the markers of {self.marker} m do not fit into squares of {self.square} m"
            )
        last = self.first_id + len(self.cells) - 1
        if not 0 <= self.first_id <= last < self.family.count:
            raise ValueError(
                f"the board needs the ids {self.first_id} to {last}; {self.family.name} has 0 to "
                f"{self.family.count - 1}"
            )

    @property
    def cells(self) -> list[tuple[int, int]]:
        """Column and row of each white square, in the order of the markers."""
        white = 0 if self.legacy and self.rows % 2 == 0 else 1
        cells = ((column, row) for row in range(self.rows) for column in range(self.columns))
        return [(column, row) for column, row in cells if (column + row) % 2 == white]

    @property
    def flat(self) -> Array:
        return flat_grid(self.columns - 1, self.rows - 1, self.square)

    @property
    def markers(self) -> list[Marker]:
        """The markers in the white squares."""
        middles = flat_grid(self.columns, self.rows, self.square)
        return [
            Marker(
                self.family,
                self.first_id + index,
                self.pose(self.marker * _UNIT_SQUARE + middles[row * self.columns + column]),
            )
            for index, (column, row) in enumerate(self.cells)
        ]

    @property
    def name(self) -> str:
        return f"charuco {self.columns}x{self.rows} of {self.family.name}"


Board = Chessboard | Charuco


def flat_grid(columns: int, rows: int, spacing: float) -> Array:
    """Return points (n,3) about the origin, row by row from the top left one."""
    y, x = np.mgrid[:rows, :columns].astype(np.float64)
    grid = np.stack([x - 0.5 * (columns - 1), 0.5 * (rows - 1) - y, np.zeros_like(x)], axis=-1)
    return np.asarray(grid.reshape(-1, 3) * spacing)


def _side(corners: Array) -> float:
    return float(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1).mean())


def _square_pose(corners: Array) -> Pose:
    """Return the pose of the square that best fits four corners; ValueError if it fits badly."""
    side, middle = _side(corners), corners.mean(axis=0)
    if side == 0.0:
        raise ValueError("all corners are the same point")
    # Least squares (Kabsch, 1976): the square that is turned into the corners.
    u, _, vt = np.linalg.svd((corners - middle).T @ _UNIT_SQUARE)
    turn = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u @ turn @ vt
    misfit = np.abs(corners - middle - side * _UNIT_SQUARE @ rotation.T).max() / side
    if misfit > _SQUARE_TOLERANCE:
        raise ValueError(
            "the corners are not a square in the order top left, top right, bottom right, bottom "
            f"left: they are {100 * misfit:.0f} % of a side away from one"
        )
    return Pose(middle, rotation)


def _positive(value: float, name: str) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 < value <= _LONGEST:
        raise ValueError(f"{name} must lie above 0 and up to {_LONGEST:g} metres, found {value!r}")
