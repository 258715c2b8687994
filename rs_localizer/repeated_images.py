# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images that repeat an earlier one, bit for bit: the camera rests, or the stream hangs.

Webcams in the dark and drivers that hang send the last image again under a new stamp, and so does a
simulated camera at rest. The velocities of the track tell them apart, or a gyroscope. Let ``d`` be
the step of the pose that they make meanwhile, and ``P`` its covariance, with that of the pose. The
camera has moved if

    d' P^-1 d > c
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rs_localizer.core.arrays import Array

# The constant c: of a camera at rest, one prediction in a hundred makes such a step (chi-squared of
# six numbers).
_CLEARLY = 16.8
_NONE = (None, None)


@dataclass(frozen=True, slots=True, eq=False)
class _Shown:
    """An image of a camera as it first came."""

    points: Array  # (n,3)
    pixels: Array  # (n,2)
    time_ns: int
    stale: bool = False  # it was shown again to a camera that had moved: what follows is as old


class RepeatedImages:
    """The last image of each camera, to know it again; one without a name is a camera alone."""

    def __init__(self) -> None:
        self._shown: dict[str, _Shown] = {}

    def copies(self, points: Any, pixels: Any) -> list[str]:
        """Return the cameras of a frame whose pixels are those of their last image, bit for bit.

        Args:
            points, pixels: as of ``Localizer.localize``; what is no frame has no copies.
        """
        return [
            name
            for name, shown in self._shown.items()
            if np.array_equal(_image(name, points, pixels)[1], shown.pixels)
        ]

    def are_all(self, points: Any, pixels: Any) -> bool:
        """Return whether a frame has images, and all are copies, of the same points."""
        names = _names(points)
        return bool(names) and all(
            (shown := self._shown.get(name)) is not None
            and all(map(np.array_equal, _image(name, points, pixels), (shown.points, shown.pixels)))
            for name in names
        )

    def add(self, time_ns: int, points: Any, pixels: Any) -> None:
        """Keep the images of a frame that are no copies; arguments as they were localized."""
        copies = self.copies(points, pixels)
        for name in _names(points):
            if name not in copies:  # as arrays of our own: the caller may use his again
                seen, where = _image(name, points, pixels)
                own = np.array(seen, np.float64), np.array(where, np.float64)
                self._shown[name] = _Shown(*own, time_ns)

    def judge(self, copies: list[str], last_ns: int) -> None:
        """Take copies of images that came until the last pose for stale: the camera has moved."""
        for name in copies:
            shown = self._shown[name]
            self._shown[name] = replace(shown, stale=shown.stale or shown.time_ns <= last_ns)

    def stale(self, copies: list[str]) -> list[str]:
        """Return those copies that a camera which has moved cannot have seen."""
        return [name for name in copies if self._shown[name].stale]


def is_clear(step: Array, covariance: Array) -> bool:
    """Return whether a step (6,) of a pose is more than its covariance (6,6) explains."""
    try:
        return bool(step @ np.linalg.solve(covariance, step) > _CLEARLY)
    except np.linalg.LinAlgError:  # rounding errors are all that is left
        return False


def _names(points: Any) -> list[str]:
    return list(points) if isinstance(points, Mapping) else [""]


def _image(name: str, points: Any, pixels: Any) -> tuple[Any, Any]:
    """Return the points and pixels of a camera in a frame; None where it has no part in it."""
    image: Any = (points, pixels) if name == "" else ()
    if isinstance(points, Mapping):
        image = points.get(name, ())
    return (image[0], image[1]) if isinstance(image, (tuple, list)) and len(image) > 1 else _NONE
