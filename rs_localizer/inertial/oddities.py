# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Words for a gyroscope that is off.

While it is used, the track's numbers tell it. A gyroscope that images contradict is not near any
numbers: its turns between images, beside the camera's, tell a matrix of it by least squares,

    camera = A gyroscope + c,    A = (U V^T) (V D V^T)

whose orthogonal part says how its axes lie, and whose stretch how fast it shows to turn.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.estimation.known_rotation import LastFrame
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.turning import DELAY, MOUNT, SCALE, GyroscopeErrors

# Images that are remembered: two seconds, in which a hand turns about all axes.
_REMEMBERED = 60
# Deviation of an element of the matrix, over its size, that tells axes (20 deg) from each other.
_MOST_DEVIATION = 0.1
# 99.9 % quantiles of chi-squared of 1 and 3 numbers: what is known to be off by more than the
# settings allow is named.
_CERTAIN = {1: 10.83, 3: 16.27}
# Rates of so many times the camera's are those of another unit. Rates and mounts (rad) that are
# closer than these to the camera's are learned from frame to frame.
_DEGREES, _FASTER, LEANING = math.degrees(1.0), math.log(1.4), 0.25
# A gyroscope that shows less than this part of a camera's rates shows none of them; the camera has
# to turn faster than images are wrong about it (rad/s).
_STILL, _TURNING = 0.003, 0.1


def told_by_numbers(errors: GyroscopeErrors, allowed: Array, before: GyroscopeErrors | None) -> str:
    """Return what a gyroscope has that the settings hardly allow for; empty: nothing.

    Args:
        errors: as the track knows them.
        allowed: (10,) variances of the settings.
        before: errors before they were learned anew; None: they never were.
    """
    said = []
    for place, words in ((SCALE, _scale), (MOUNT, _mount), (DELAY, _delay)):
        off, known = errors.mean[place], errors.covariance[place, place]
        certain = off @ np.linalg.solve(known, off) > _CERTAIN[len(off)]
        if certain and np.mean(off**2) > allowed[place.start]:
            said.append(words(off))
    if before is not None:  # the delay may be another one since it is learned anew
        step = errors.time_offset - before.time_offset
        variance = errors.covariance[DELAY, DELAY] + before.covariance[DELAY, DELAY]
        if step**2 > _CERTAIN[1] * variance.item():
            said.append(f"its stamps stepped by {1e3 * abs(step):.0f} ms")
    return " and ".join(said)


def _scale(off: Array) -> str:
    share = float(off[np.abs(off).argmax()])
    return f"it turns {100.0 * abs(share):.0f} % too {'fast' if share > 0.0 else 'slowly'}"


def _mount(off: Array) -> str:
    return f"its mount is {math.degrees(np.linalg.norm(off)):.0f} deg off"


def _delay(off: Array) -> str:
    return f"its stamps are {1e3 * abs(off[0]):.0f} ms {'early' if off[0] > 0.0 else 'late'}"


class ComparedTurns:
    """The last turns of a camera between images, and those that its gyroscope shows."""

    def __init__(self) -> None:
        self._rates: deque[Array] = deque(maxlen=_REMEMBERED)  # (7,) gyroscope, 1, camera; rad/s
        self._last: LastFrame | None = None
        self._told = ""

    def add(self, samples: ImuSamples, last: LastFrame) -> None:
        """Take the turn to the last image; samples reach back to the one before, if it counts."""
        before, self._last = self._last, last
        if before is None or not samples.times_ns[0] < before.middle_ns < last.middle_ns:
            return
        times = 1e-9 * (samples.times_ns - before.middle_ns)
        seconds = 1e-9 * (last.middle_ns - before.middle_ns)
        within = np.linspace(0.0, seconds, 20)
        shown = [np.interp(within, times, rates).mean() for rates in samples.angular_velocity.T]
        turn = np.ascontiguousarray(before.motion.rotation @ last.motion.rotation.T)
        self._rates.append(np.array([*shown, 1.0, *so3.log(turn) / seconds]))

    def told(self) -> str:
        """Return what the gyroscope has, in words, as long as they told it last; empty: nothing."""
        if len(self._rates) < _REMEMBERED // 3:
            return self._told
        shown, camera = np.split(np.array(self._rates), [4], axis=1)
        shown[:, :3] -= shown[:, :3].mean(axis=0)
        known, turns = shown.T @ shown, camera - camera.mean(axis=0)
        if known[:3, :3].trace() < _STILL**2 * np.sum(turns**2) and np.std(turns) > _TURNING:
            self._told = "it always shows the same rates"
        if np.linalg.cond(known) > 1e12:
            return self._told
        found = np.linalg.solve(known, shown.T @ camera)
        noise = np.mean((camera - shown @ found) ** 2) * np.linalg.inv(known)[:3, :3]
        left, sizes, right = np.linalg.svd(found[:3].T)
        if math.sqrt(noise.diagonal().max()) < _MOST_DEVIATION * sizes[-1]:
            said = _axes(left @ right), _faster(-float(np.log(sizes).mean()))
            self._told = " and ".join(filter(None, said))
        return self._told


def _axes(turn: Array) -> str:
    """Say how axes lie, by an orthogonal matrix (3,3) camera_from_gyroscope."""
    nearest = np.where(np.abs(turn) == np.abs(turn).max(axis=1)[:, None], np.sign(turn), 0.0)
    if np.array_equal(nearest, np.eye(3)):
        angle = so3.log(np.ascontiguousarray(turn))
        return _mount(angle) if float(np.linalg.norm(angle)) > LEANING else ""
    if not np.array_equal(nearest @ nearest.T, np.eye(3)):
        return ""
    axes = [("-" if row.sum() < 0.0 else "") + "xyz"[np.abs(row).argmax()] for row in nearest]
    mirrored = "" if np.linalg.det(turn) > 0.0 else ", which no mount does: a sign is wrong"
    return f"the camera's x y z are its {' '.join(axes)}{mirrored}"


def _faster(faster: float) -> str:
    """Say how fast it shows to turn, by the logarithm of the factor."""
    if abs(faster) < _FASTER:
        return ""
    unit = abs(abs(faster) - math.log(_DEGREES)) < _FASTER
    why = "" if not unit else ": degrees, not radians" if faster > 0.0 else ": not degrees"
    return f"it shows {math.exp(faster):.2g} times the camera's rates{why}"
