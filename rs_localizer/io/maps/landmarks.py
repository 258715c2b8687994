# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A map: landmarks with ids or descriptors, by which they are recognized."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array

Ids = NDArray[np.int64]
Descriptors = NDArray[np.uint8] | NDArray[np.float32]

# PointField has no wider integers: all ids fit the one or the other.
_ID_TYPES = (np.dtype("<u4"), np.dtype("<i4"))
# Beyond this, float32 pixels and poses say nothing (m).
_FARTHEST = 1e9
# Single precision is 1 mm coarse there (m).
_FARTHEST_SINGLE = 1e4


class MapError(ValueError):
    """A map that cannot be used; the text says what was found."""


@dataclass(frozen=True, slots=True, eq=False)
class Map:
    """Landmarks in one frame.

    Args:
        points: (n,3) m.
        ids: (n,) each of one landmark alone, or None.
        descriptors: (n,d) uint8, binary ones that are compared bit by bit, or float32, compared
            by their Euclidean distance; or None.
        frame: in which the points are given.
        dropped: landmarks that were left out because they held NaN or infinity, or because no
            descriptor of theirs is known.
        covariances: (n,3,3) m^2, NaN if unknown; or None.
        error_modes: (n,3,k) float32, m: by how much one standard deviation of each of k independent
            errors moves them all; beside ``covariances``, in which these are not; or None.

    Raises:
        MapError: without a landmark, a frame, or with points that are nowhere.
    """

    points: Array
    ids: Ids | None
    descriptors: Descriptors | None
    frame: str
    dropped: int = 0
    covariances: Array | None = None
    error_modes: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        if len(self) == 0:
            dropped = f"; {self.dropped} with NaN or infinity were dropped" if self.dropped else ""
            raise MapError(f"the map has no landmarks{dropped}")
        if not self.frame:
            raise MapError("the map's frame has no name")
        if not np.abs(self.points).max() < _FARTHEST:
            raise MapError(f"points must be finite and within {_FARTHEST:g} m")

    def __len__(self) -> int:
        return len(self.points)

    def equals(self, other: Map) -> bool:
        """Return True if both maps are the same to the last bit, in the same frame."""
        parts = ("points", "ids", "descriptors", "covariances", "error_modes")
        return self.frame == other.frame and all(
            _equal(getattr(self, part), getattr(other, part)) for part in parts
        )

    @property
    def point_type(self) -> str:
        """The type of a PointField for coordinates: FLOAT32, which RViz shows, if it is exact."""
        return "<f4" if np.abs(self.points).max() < _FARTHEST_SINGLE else "<f8"

    @property
    def id_type(self) -> np.dtype[Any]:
        """The type of a PointField that holds all ids."""
        ids = np.zeros(1, np.int64) if self.ids is None else self.ids
        return next(kind for kind in _ID_TYPES if _fit(ids, kind))


def make_map(
    points: NDArray[Any],
    ids: NDArray[Any] | None,
    descriptors: NDArray[Any] | None,
    frame: str,
    covariances: NDArray[Any] | None = None,
    error_modes: NDArray[Any] | None = None,
) -> Map:
    """Make a map of arrays as read, with the shapes of :class:`Map`.

    Landmarks with a value that is not finite are dropped and counted.

    Raises:
        MapError: for arrays that make no map, saying what was found.
    """
    if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
        raise MapError(f"points must be (n,3) numbers, found {points.shape} {points.dtype}")
    points = np.ascontiguousarray(points, dtype=np.float64)
    finite = np.isfinite(points).all(axis=1)
    if ids is not None and (ids.shape != (len(points),) or ids.dtype.kind not in "iu"):
        raise MapError(f"ids must be ({len(points)},) integers, found {ids.shape} {ids.dtype}")
    if descriptors is not None:
        if descriptors.ndim != 2 or len(descriptors) != len(points) or not descriptors.shape[1]:
            raise MapError(f"descriptors must be ({len(points)},d), found {descriptors.shape}")
        if descriptors.dtype.kind == "f":
            with np.errstate(over="ignore"):
                descriptors = np.ascontiguousarray(descriptors, dtype=np.float32)
            finite &= np.isfinite(descriptors).all(axis=1)
        elif descriptors.dtype == np.uint8:
            descriptors = np.ascontiguousarray(descriptors)
        else:
            raise MapError(f"descriptors must be uint8 or floats, found {descriptors.dtype}")
    if covariances is not None:
        if covariances.shape != (len(points), 3, 3) or covariances.dtype.kind not in "fiu":
            raise MapError(f"covariances must be ({len(points)},3,3), found {covariances.shape}")
        covariances = np.ascontiguousarray(covariances, dtype=np.float64)
        variances = covariances.diagonal(axis1=1, axis2=2)
        bad = (variances < 0.0).any(axis=1) | np.isinf(covariances).any(axis=(1, 2))
        if bad.any():
            row = int(np.argmax(bad))
            raise MapError(
                "covariances must have finite variances of 0 or more (NaN: not known), found "
                f"{variances[row].tolist()} m^2 at index {row}"
            )
    if error_modes is not None:
        shape, kind = error_modes.shape, error_modes.dtype.kind
        if len(shape) != 3 or shape[:2] != points.shape or kind not in "fiu":
            raise MapError(f"error_modes must be ({len(points)},3,k), found {shape}")
        with np.errstate(over="ignore"):
            error_modes = np.ascontiguousarray(error_modes, dtype=np.float32)
        finite &= np.isfinite(error_modes).all(axis=(1, 2))
    dropped = len(points) - int(np.count_nonzero(finite))
    if dropped:
        points = points[finite]
        ids, descriptors, covariances, error_modes = (
            None if part is None else part[finite]
            for part in (ids, descriptors, covariances, error_modes)
        )
    if ids is not None:
        _check_ids(ids)  # before they are converted, which may wrap them
        ids = np.ascontiguousarray(ids, dtype=np.int64)
    return Map(points, ids, descriptors, frame, dropped, covariances, error_modes)


def _equal(one: NDArray[Any] | None, other: NDArray[Any] | None) -> bool:
    if one is None or other is None:
        return one is other
    return one.dtype == other.dtype and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def _check_ids(ids: NDArray[Any]) -> None:
    if len(ids) and not any(_fit(ids, kind) for kind in _ID_TYPES):
        raise MapError(
            "ids must lie between 0 and 4294967295 or between -2147483648 and 2147483647, the "
            f"integers of a PointCloud2; found {ids.min()} to {ids.max()}"
        )
    known, counts = np.unique(ids, return_counts=True)
    if len(repeated := known[counts > 1]):
        raise MapError(
            f"{len(repeated)} ids stand for several landmarks each, the first of them is "
            f"{repeated[0]}"
        )


def _fit(ids: NDArray[Any], kind: np.dtype[Any]) -> bool:
    limits = np.iinfo(kind)
    return bool(limits.min <= ids.min() and ids.max() <= limits.max)
