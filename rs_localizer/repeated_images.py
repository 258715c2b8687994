# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Images that repeat an earlier one, bit for bit: the camera rests, or the stream hangs.

Webcams in the dark and drivers that hang send the last image again under a new stamp, and so does a
simulated camera at rest. The prediction of the motion tells them apart. Let ``d`` (2,) be the
displacement of a pixel from its place in the image to its predicted place, and ``n`` its noise. Let
``P`` be the predicted covariance of the pose, ``J`` the derivative of the pixel by the pose. The
camera has moved if, for some pixel,

    d' (n^2 I + J P J')^-1 d > c^2
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.bearings import seen_at
from rs_localizer.core.camera import Camera
from rs_localizer.core.rig import Rig
from rs_localizer.core.shutter import Motion
from rs_localizer.core.state import PARAMETERS, POSE, VELOCITIES
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import Prior

# The constant c: of a camera at rest, one prediction in a hundred has such a displacement.
_CLEARLY = 3.0
# Of the distance of a point, for the derivative of its pixel.
_STEP = 1e-6
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

    def judge(
        self, copies: list[str], rig: Rig, last: Estimate, last_ns: int, prior: Prior | None
    ) -> None:
        """Learn from a prediction which of these copies are stale.

        Args:
            copies: see :meth:`copies`.
            rig: the cameras.
            last, last_ns: the last frame with a pose, and its time.
            prior: prediction of the motion in this one; None: nothing is known.
        """
        if prior is None:
            return
        noise = last.residual_rms / math.sqrt(2.0)  # along each axis
        for name in copies:
            shown, camera = self._shown[name], name or next(iter(rig.cameras))
            if shown.time_ns > last_ns:  # there was no pose when it came first
                continue
            axes, shift = rig.camera_from_rig[camera]
            see = partial(_seen, rig.cameras[camera], axes, shift)
            if displacement(see, shown.points, last, prior, noise) > _CLEARLY:
                self._shown[name] = replace(shown, stale=True)

    def stale(self, copies: list[str]) -> list[str]:
        """Return those copies that a camera which has moved cannot have seen."""
        return [name for name in copies if self._shown[name].stale]


def coasting(motion: Motion, covariance: Array, readouts: float) -> Prior:
    """Predict where a motion leads with its velocities; unresolved ones count as rest.

    What accelerations may change is no doubt of that: a camera that rests then and now has none.

    Args:
        motion: its velocities are per readout.
        covariance: (18,18) of it.
        readouts: time.
    """
    turn = np.ascontiguousarray(so3.exp(-readouts * motion.angular_velocity))
    moved = motion.translation - readouts * motion.linear_velocity
    pose = np.full(PARAMETERS, 1.0)  # of which the pose alone is asked
    doubt = np.diag(pose)
    doubt[POSE, POSE] = readouts**2 * covariance[VELOCITIES, VELOCITIES]
    return Prior(
        motion=replace(motion, rotation=turn @ motion.rotation, translation=turn @ moved),
        covariance=doubt,
    )


def displacement(
    see: Callable[[Array], Array], points: Array, last: Motion, prior: Prior, noise: float
) -> float:
    """Return how far a prediction moves the pixel that moves most, in its deviations.

    Args:
        see: pixels (n,2) of points (n,3) in the axes of the motions; NaN behind the camera.
        points: (n,3) of the map.
        last: the motion that was seen.
        prior: prediction of the motion, a while later; one that knows nothing moves no pixel.
        noise: px, of a pixel along each axis.
    """
    if prior.motion is None or prior.covariance is None:
        return 0.0
    pose = np.asarray(prior.covariance, np.float64)[POSE, POSE]
    if not np.isfinite(pose).all():
        return 0.0
    before = points @ np.asarray(last.rotation).T + last.translation
    after = points @ np.asarray(prior.motion.rotation).T + prior.motion.translation
    steps = _STEP * np.linalg.norm(after, axis=1)[:, None, None] * np.eye(3)
    by_point = np.stack(
        [(see(after + steps[:, k]) - see(after - steps[:, k])) for k in range(3)], axis=2
    ) / (2.0 * steps[:, [0], [0]][:, None])
    # A turn of the camera by a small r, and a shift by s, move a point x to x + x X r - s.
    turned = np.cross(after[:, None], np.eye(3)).transpose(0, 2, 1)
    by_pose = by_point @ np.concatenate([turned, -np.broadcast_to(np.eye(3), turned.shape)], axis=2)
    covariance = by_pose @ pose @ by_pose.transpose(0, 2, 1) + noise**2 * np.eye(2)
    moved = see(after) - see(before)
    known = np.isfinite(moved).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2))
    moved, covariance = moved[known], covariance[known]
    try:
        weighed = np.linalg.solve(covariance, moved[..., None])[..., 0]
    except np.linalg.LinAlgError:  # neither noise nor doubt is left: rounding errors
        return 0.0
    squared = np.sum(moved * weighed, axis=1)
    return math.sqrt(max(float(squared.max(initial=0.0)), 0.0))


def _seen(camera: Camera, axes: Array, shift: Array, points: Array) -> Array:
    return seen_at(camera, points @ axes.T + shift)


def _names(points: Any) -> list[str]:
    return list(points) if isinstance(points, Mapping) else [""]


def _image(name: str, points: Any, pixels: Any) -> tuple[Any, Any]:
    """Return the points and pixels of a camera in a frame; None where it has no part in it."""
    image: Any = (points, pixels) if name == "" else ()
    if isinstance(points, Mapping):
        image = points.get(name, ())
    return (image[0], image[1]) if isinstance(image, (tuple, list)) and len(image) > 1 else _NONE
