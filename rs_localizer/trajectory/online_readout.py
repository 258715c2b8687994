# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The readout time from neighbouring frames, while the camera runs.

One image shows how far the camera turns and travels during its readout; the poses of the frames
before and after it show how fast it does. The ratio is the readout time, negative where the
shutter runs against the direction that was assumed. Of each frame and its two neighbours,

    y = T x + noise,    y: mean motion per readout (Simpson's rule), x: way between the outer
                        poses by time,

both in the camera's axes, angular and linear (6). Both sides are noisy and their noise belongs
together, so that plain least squares would be biased, to anything at rest: the estimating equation
is corrected by what the frames' covariances expect of the noise. The deviation comes from the
scatter of the equation's own terms (a sandwich with Bartlett's weights), not from the covariances.

Each frame counts with what its image alone says
(:mod:`rs_localizer.trajectory.single_image_likelihood`): the estimate of a tracked frame believes
in the readout time that the tracker was given.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.shutter import Motion
from rs_localizer.core.types import Estimate
from rs_localizer.trajectory.readout_equations import (
    SIDE,
    Equations,
    MeasuredReadout,
    Measurement,
    View,
    equation,
    jumps,
)
from rs_localizer.trajectory.shutter_hypotheses import ShutterHypotheses
from rs_localizer.trajectory.single_image_likelihood import single_image_likelihood

REVERSED = {
    ScanDirection.TOP_TO_BOTTOM: ScanDirection.BOTTOM_TO_TOP,
    ScanDirection.BOTTOM_TO_TOP: ScanDirection.TOP_TO_BOTTOM,
    ScanDirection.LEFT_TO_RIGHT: ScanDirection.RIGHT_TO_LEFT,
    ScanDirection.RIGHT_TO_LEFT: ScanDirection.LEFT_TO_RIGHT,
}
"""The opposite of each direction."""

# Motion before this (s) is forgotten.
_WINDOW = 10.0
# Neighbours farther away (s), or of intervals less alike than this, say little.
_LONGEST_INTERVAL, _MOST_UNLIKE = 0.15, 2.5
# Fewer triples than this have no scatter worth the name.
_LEAST_TRIPLES = 20
_LEAST_ROOM = 64  # triples
_MOST_POINTS = 200  # of a frame: more take longer than they are worth


class _Window:
    """The equations of the last seconds, in their order, one behind the other in memory."""

    def __init__(self) -> None:
        self._times_ns = np.empty(_LEAST_ROOM, np.int64)
        self._all = _room(_LEAST_ROOM)
        self._first, self._end = 0, 0

    def __len__(self) -> int:
        return self._end - self._first

    def clear(self) -> None:
        """Forget all; equations that were given away stay what they are."""
        self._all = _room(len(self._times_ns))
        self._first = self._end = 0

    def add(self, time_ns: int, views: Sequence[View], first: float, second: float) -> None:
        """Add the equation of three views, so many seconds apart."""
        if self._end == len(self._times_ns):
            self._make_room()
        before, now, after = views
        equation(before, now, after, first, second, self._all, self._end)
        self._times_ns[self._end] = time_ns
        self._end += 1

    def forget(self, before_ns: int) -> None:
        """Forget what is older."""
        while self._first < self._end and self._times_ns[self._first] < before_ns:
            self._first += 1

    def equations(self) -> Equations:
        return Equations(*(part[self._first : self._end] for part in self._all))

    def newest(self, count: int) -> Equations:
        """The last ones."""
        return Equations(*(part[self._end - count : self._end] for part in self._all))

    def _make_room(self) -> None:
        held, times_ns = self.equations(), self._times_ns[self._first : self._end]
        size = max(2 * len(self), _LEAST_ROOM)
        self._all, self._times_ns = _room(size), np.empty(size, np.int64)
        self._first, self._end = 0, len(times_ns)
        self._times_ns[: self._end] = times_ns
        for part, filled in zip(self._all, held, strict=True):
            part[: self._end] = filled


def _room(size: int) -> Equations:
    sides, covariances = (size, SIDE), (size, SIDE, SIDE)
    return Equations(np.empty(sides), np.empty(sides), *(np.empty(covariances) for _ in range(3)))


class ReadoutMonitor:
    """Measures the readout time over a sliding window of frames.

    Args:
        window: s.
    """

    def __init__(self, window: float = _WINDOW) -> None:
        self._window_ns = round(window * 1e9)
        self._views: deque[tuple[int, View]] = deque(maxlen=3)
        self._window = _Window()
        self._in_a_row = 0  # triples, each one frame after the other
        self.odds = ShutterHypotheses()

    def reset(self) -> None:
        """Forget all frames: the camera, the map or the assumed direction has changed."""
        self._views.clear()
        self._window.clear()
        self._in_a_row = 0
        self.odds.reset()

    def add(
        self, time_ns: int, camera: Camera, estimate: Estimate, points: Array, pixels: Array
    ) -> None:
        """Take a frame whose middle row was exposed at ``time_ns``.

        Args:
            camera: its lens and scan direction count; its readout time is compared with none.
            estimate: of this frame, tracked or not.
            points, pixels: (n,3) and (n,2) as they were localized.

        Frames come in order; one that does not follow the last starts afresh.
        """
        if self._views and time_ns <= self._views[-1][0]:
            self.reset()
        chosen = np.flatnonzero(estimate.inliers)
        chosen = chosen[:: 1 + len(chosen) // _MOST_POINTS]
        # Without accelerations and shaking: what a prior has wrong about the velocities, they mend.
        steady = Motion(
            estimate.rotation,
            estimate.translation,
            estimate.angular_velocity,
            estimate.linear_velocity,
        )
        alone = single_image_likelihood(camera, steady, points[chosen], pixels[chosen])
        if alone is None:
            self._views.clear()
            self._in_a_row = 0
            return
        offset, covariance = alone
        motion = np.concatenate([estimate.angular_velocity, estimate.linear_velocity])
        map_from_camera = estimate.rotation.T
        view = View(
            map_from_camera @ so3.exp(offset[:3]),
            estimate.position + map_from_camera @ offset[3:6],
            motion + offset[6:],
            covariance,
        )
        self._views.append((time_ns, view))
        if len(self._views) == 3:
            self._add_equation(camera.readout_time)
        self._window.forget(time_ns - self._window_ns)

    def _add_equation(self, readout_time: float) -> None:
        (before_ns, _), (now_ns, _), (after_ns, _) = self._views
        first, second = (now_ns - before_ns) * 1e-9, (after_ns - now_ns) * 1e-9
        before, now, after = (view for _, view in self._views)
        alike = 1.0 / _MOST_UNLIKE < first / second < _MOST_UNLIKE
        near = max(first, second) <= _LONGEST_INTERVAL
        if not (alike and near) or jumps(before, now, after, first, second):
            self._in_a_row = 0
            return
        self._window.add(now_ns, (before, now, after), first, second)
        self._in_a_row += 1
        if self._in_a_row > 1 and readout_time > 0.0:
            self.odds.add(self._window.newest(2), readout_time)

    def measure(self) -> MeasuredReadout | None:
        """What the window shows; None as long as the motion determines nothing.

        Raises:
            LinAlgError: a frame in the window has no covariance.
        """
        measurement = self.measurement()
        return None if measurement is None else measurement.finish()

    def measurement(self) -> Measurement | None:
        """The same, to be computed bit by bit; None as long as there are too few frames."""
        if len(self._window) < _LEAST_TRIPLES:
            return None
        return Measurement(self._window.equations())


def warm_up(camera: Camera) -> None:
    """Compile every kernel that frames of this camera may need, or load it from the cache."""
    pixels = np.random.default_rng(0).uniform(0.3, 0.7, (20, 2)) * camera.size
    points = np.column_stack([np.nan_to_num(camera.rays(pixels)), np.ones(len(pixels))])
    single_image_likelihood(camera, Motion(np.eye(3), *np.zeros((3, 3))), points, pixels)
    window, view = _Window(), View(np.eye(3), np.zeros(3), np.zeros(SIDE), np.eye(2 * SIDE))
    window.add(0, [view, view, view], 1.0, 1.0)
    jumps(view, view, view, 1.0, 1.0)
    Measurement(window.equations()).finish()
    window.add(1, [view, view, view], 1.0, 1.0)
    ShutterHypotheses().add(window.newest(2), 1.0)
