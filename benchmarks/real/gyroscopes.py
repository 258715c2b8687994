# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Gyroscopes that are held back as a truth, and how they are laid over a recording."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from benchmarks.real.recordings import Recording
from rs_localizer.core.arrays import Array
from rs_localizer.localizer import Localizer

_OFFSETS = np.arange(-0.5, 0.502, 0.002)  # s, by which clocks of one device may differ
_FEWEST = 20  # turns between neighbours that tell of clock, axes and bias
# Of the interval: what stamps of one image may be off, from the first row's start to the last row.
_NEAR_IMAGE = 0.25


@dataclass(frozen=True, slots=True, eq=False)
class Gyroscope:
    """Turn rates (k,3) rad/s in camera axes at times (k,) s."""

    times: Array
    rates: Array

    @classmethod
    def read(cls, path: Path) -> Gyroscope:
        """A text of ``t wx wy wz``; raises ``ValueError`` for another."""
        table = np.atleast_2d(np.loadtxt(path))
        if table.shape[1] != 4 or len(table) < 2 or not np.all(np.diff(table[:, 0]) > 0.0):
            raise ValueError(
                f"{path} must hold lines t wx wy wz (s, rad/s) in the order of time, found "
                f"{table.shape[0]} of {table.shape[1]} numbers"
            )
        return cls(table[:, 0], table[:, 1:])

    def mean_rate(self, first: Array, last: Array) -> Array:
        """Mean rates (n,3) rad/s between times (n,) s."""
        step = 0.5 * (self.rates[1:] + self.rates[:-1]) * np.diff(self.times)[:, None]
        angles = np.vstack([np.zeros(3), np.cumsum(step, axis=0)])

        def at(time: Array) -> Array:
            return np.stack([np.interp(time, self.times, angles[:, k]) for k in range(3)], axis=1)

        return np.asarray((at(last) - at(first)) / (last - first)[:, None])


def aligned(gyroscope: Gyroscope, recording: Recording) -> tuple[Gyroscope, str]:
    """By the clock of the stamps, in the camera's axes, and without bias; and what was found.

    Seven numbers for a whole recording, by the turns between neighbouring poses, each of one image:
    they tell nothing of the twist of any. By the turns of solvePnP, which the shutter bends, clock
    and bias of a rendered board were off by 1.9 ms and 0.6 deg/s instead of 0.1 and 0.14.

    Raises:
        ValueError: where too few neighbours are localized.
    """
    localizer = Localizer(recording.camera)
    poses = [localizer.localize(each.points, each.pixels) for each in recording.frames]
    times = 1e-9 * np.array([frame.middle_ns for frame in recording.frames])
    pairs = [k for k in range(len(poses) - 1) if poses[k] and poses[k + 1]]
    if len(pairs) < _FEWEST:
        raise ValueError(f"{len(pairs)} pairs of neighbours are localized, {_FEWEST} are needed")
    first, last = times[pairs], times[np.array(pairs) + 1]
    turns = [
        (Rotation.from_matrix(a.rotation) * Rotation.from_matrix(b.rotation).inv()).as_rotvec()
        for a, b in ((poses[k], poses[k + 1]) for k in pairs) if a and b
    ]  # fmt: skip
    seen = np.array(turns) / (last - first)[:, None]

    def rates(offset: float) -> Array:
        return gyroscope.mean_rate(first - offset, last - offset)

    offset, _ = best_offset(seen, rates)
    axes, _ = Rotation.align_vectors(seen, rates(offset))

    def errors(numbers: Array) -> Array:
        turned = Rotation.from_rotvec(numbers[1:4]).apply(rates(numbers[0]) - numbers[4:])
        return np.asarray((turned - seen).ravel())

    noise = max(float(np.median(np.abs(errors(np.r_[offset, axes.as_rotvec(), 0, 0, 0])))), 1e-4)
    found = least_squares(
        errors, np.r_[offset, axes.as_rotvec(), np.zeros(3)], loss="soft_l1", f_scale=noise,
        x_scale=np.r_[1e-3, np.full(6, 1e-2)],
    ).x  # fmt: skip
    turned = Rotation.from_rotvec(found[1:4]).apply(gyroscope.rates - found[4:])
    angle, bias = np.degrees(np.linalg.norm(found[1:].reshape(2, 3), axis=1))
    said = (
        f"gyroscope: {in_images(found[0], times)}, turned by {angle:.1f} deg, bias {bias:.2f} deg/s"
    )
    return Gyroscope(gyroscope.times + found[0], turned), said


def best_offset(seen: Array, rates: Callable[[float], Array]) -> tuple[float, float]:
    """Offset of clocks (s) at which turn rates (n,3) are most like others, and how much they are.

    Axes and bias need not be known: the likeness is the correlation after the best rotation.

    Args:
        rates: the others, for an offset.
    """
    alike = [_likeness(seen, rates(offset)) for offset in _OFFSETS]
    best = int(np.argmax(alike))
    return float(_OFFSETS[best]), alike[best]


def _likeness(seen: Array, rates: Array) -> float:
    one, other = seen - seen.mean(axis=0), rates - rates.mean(axis=0)
    left, sizes, right = np.linalg.svd(one.T @ other)
    # A mirror is no rotation.
    sizes[2] *= np.sign(np.linalg.det(left @ right))
    return float(np.sum(sizes) / max(np.linalg.norm(one) * np.linalg.norm(other), 1e-12))


def in_images(offset: float, times: Array) -> str:
    """An offset of clocks in ms, with a warning where it is that of whole images.

    Args:
        times: of the images, s.
    """
    images = offset / float(np.median(np.diff(times)))
    said = f"{1e3 * offset:+.1f} ms"
    whole = round(images)
    if whole and abs(images - whole) < _NEAR_IMAGE:
        said += f" ({whole:+d} images: each has the stamp of another one)"
    return said
