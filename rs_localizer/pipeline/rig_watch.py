# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Watch over a rig: its cameras are mounted, and their clocks set, as they are said to be.

Each camera is tracked alone, so that it does not matter what the others do to the pose of the rig.
With the pose of a camera as it sees it and as the first camera, the reference, predicts it by the
extrinsics, the difference in the camera's own axes is

    d = delta + v o + noise

where ``delta`` (translation, turn) is what the extrinsics lack, ``o`` what is to be added to the
camera's stamps, and ``v`` its velocity. A Kalman filter of the seven numbers of each camera, in
which offsets walk and extrinsics rest, weighs the differences by the covariances of both poses.
The reference is interpolated between its images, where errors of its velocity cancel. What lenses
may be off by (``calibration.*``) is the same in all frames, and so added to the result.

Of 298 differences of a hand-held pair (100 points, 0.5 px, 20 % outliers), the normalized squares
had a mean of 0.8 and those of successive frames a correlation of 0.1: they count as independent.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from rs_localizer.config import NodeConfig, RefinementKind
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.reasons import Notice
from rs_localizer.core.types import Estimate
from rs_localizer.io.transforms import Transform
from rs_localizer.localizer import Localizer
from rs_localizer.pipeline.pose_at_time import pose_at, twist_at
from rs_localizer.pipeline.published import Mounting, base_pose
from rs_localizer.pipeline.refusal import Notify
from rs_localizer.pipeline.rig_frames import CameraImage
from rs_localizer.solvers.table import find_solver
from rs_localizer.tracking import Tracker

# False alarms: 1e-4 of a chi-squared of six (delta, and innovations) and of a normal (offsets).
_SURELY_SIX, _SURELY_ONE = 27.9, 3.9
# Differences before a verdict, so that all cameras have some before one of them is blamed.
_ENOUGH = 30
# Innovations in a row that contradict: another mounting, or another time.
_CHANGED = 5
# s/sqrt(s), random walk of offsets: quartz is off by 5e-5, which the filter lags by 0.1 ms.
_WALK = 1e-4
# m and rad, of extrinsics of which nothing is known yet.
_ANY = 1.0
# s, of a clock that is off: half a pixel at 1 rad/s.
_LEAST_OFFSET = 1e-3
# As long as mountings agree, a third of the frames is compared; a track does not outlast a gap of
# half a second.
_ON, _CYCLE = 4, 12
# s between two images of the reference that are interpolated.
_LONGEST = 0.25
_NOTHING = np.zeros((12, 12))


class _Sight(NamedTuple):
    time_ns: int  # middle of the exposure, by the camera's own clock
    estimate: Estimate


@dataclass(slots=True, eq=False)
class _Fit:
    """Error of one camera: translation and turn in its axes, offset; and their covariance."""

    covariance: Array  # (7,7)
    mean: Array = field(default_factory=lambda: np.zeros(7))
    floor: Array = field(default_factory=lambda: np.zeros((6, 6)))  # of the lenses
    count: int = 0
    contradicted: int = 0  # in a row
    time_ns: int = 0

    def add(self, time_ns: int, difference: Array, velocity: Array, noise: Array) -> bool:
        """Take a difference (6,); whether it agrees."""
        seconds = 1e-9 * max(time_ns - self.time_ns, 0) if self.time_ns else 0.0
        self.covariance[6, 6] += _WALK**2 * seconds
        self.time_ns = time_ns
        design = np.c_[np.eye(6), velocity]
        expected = design @ self.covariance @ design.T + noise
        innovation = difference - design @ self.mean
        weighed = np.linalg.solve(expected, np.c_[innovation, design @ self.covariance])
        if innovation @ weighed[:, 0] > _SURELY_SIX:
            self.contradicted += 1
            return False
        self.contradicted, self.count = 0, self.count + 1
        gained = self.covariance @ design.T
        self.mean = self.mean + gained @ weighed[:, 0]
        self.covariance = self.covariance - gained @ weighed[:, 1:]
        self.covariance = 0.5 * (self.covariance + self.covariance.T)
        return True

    @property
    def of_extrinsics(self) -> tuple[Array, Array]:
        """Translation and turn (6,) and their covariance."""
        return self.mean[:6], self.covariance[:6, :6] + self.floor

    @property
    def offset_deviation(self) -> float:
        """s."""
        return math.sqrt(self.covariance[6, 6])

    @property
    def off(self) -> bool:
        """True if the extrinsics are certainly others."""
        mean, covariance = self.of_extrinsics
        score = float(mean @ np.linalg.solve(covariance, mean))
        return self.count >= _ENOUGH and score > _SURELY_SIX

    def described(self) -> str:
        """Sizes of the extrinsics' errors."""
        mean, covariance = self.of_extrinsics
        texts = []
        for part, scale, unit in ((slice(3, 6), 180.0 / math.pi, "deg"), (slice(3), 1e3, "mm")):
            size = float(np.linalg.norm(mean[part]))
            along = mean[part] / max(size, 1e-12)
            deviation = math.sqrt(along @ covariance[part, part] @ along)
            texts.append(f"{scale * size:.2f} +- {scale * deviation:.2f} {unit}")
        return " and ".join(texts)


class RigWatch:
    """Tracks each camera of a rig alone, and says what contradicts.

    Args:
        config: settings.
        notice: told of a contradiction once.
    """

    def __init__(self, config: NodeConfig, notice: Notify) -> None:
        self._config, self._notice = config, notice
        self._names = config.cameras
        self._rolling = find_solver(config.solver).rolling_shutter
        # Orientations that are not worth publishing still say something.
        self._alone = replace(
            config, max_orientation_deviation=10.0, refinement=RefinementKind.FULL
        )
        self.reset()

    def reset(self) -> None:
        """Forget all frames, and what came of them."""
        self._trackers: dict[str, Tracker] = {}
        self._sights: dict[str, deque[_Sight]] = {n: deque(maxlen=8) for n in self._names}
        self._fits = {name: self._fresh() for name in self._names[1:]}
        self._said: set[tuple[Notice, str]] = set()
        self._refused, self._frames = True, 0
        self.values: dict[str, str] = {}
        """What is known of each camera, by readable names."""
        self.faults: dict[str, str] = {}
        """What contradicts, by the name of its notice."""

    def _fresh(self) -> _Fit:
        """Nothing is known; beyond half a window images are not of one frame anyway."""
        return _Fit(np.diag(np.r_[np.full(6, _ANY), 0.5 * self._config.rig.window]) ** 2)

    def judge(self, localized: bool) -> None:
        """Take note of whether a frame of all was localized."""
        self._refused = not localized

    def add(self, image: CameraImage, camera: Camera, mounts: Mapping[str, Transform]) -> None:
        """Take an image, and where the cameras are in the rig."""
        name, reference = image.camera, self._names[0]
        self._frames += name == reference
        sure = all(fit.count >= _ENOUGH and not fit.off for fit in self._fits.values())
        idle = sure and not self._refused and self._frames % _CYCLE >= _ON
        if idle or not self._rolling or len(self._names) < 2:
            return
        if name not in self._trackers:
            self._trackers[name] = Tracker(Localizer(camera, self._alone))
        time_ns, cloud = image.middle_ns, image.cloud
        result = self._trackers[name].localize(time_ns, cloud.points, cloud.pixels, cloud.scores)
        if not result:
            return
        self._sights[name].append(_Sight(time_ns, result))
        if reference in mounts:
            for other in self._fits if name == reference else [name]:
                if other in self._fits and other in mounts:
                    self._compare(other, mounts[other] @ mounts[reference].inverse())

    def _compare(self, name: str, extrinsics: Transform) -> None:
        """Compare all images of a camera between two of the reference."""
        waiting, others = self._sights[name], list(self._sights[self._names[0]])
        while waiting and others and waiting[0].time_ns <= others[-1].time_ns:
            sight = waiting.popleft()
            time_ns = sight.time_ns
            later = next(i for i, other in enumerate(others) if other.time_ns >= time_ns)
            pair = others[max(later - 1, 0) : later + 1]
            if others[later].time_ns == time_ns:
                pair = [others[later]]
            span_ns = pair[-1].time_ns - pair[0].time_ns
            if pair[0].time_ns <= time_ns and span_ns < _LONGEST * 1e9:
                self._take(name, sight, pair, extrinsics)

    def _take(self, name: str, sight: _Sight, pair: list[_Sight], extrinsics: Transform) -> None:
        fit, time_ns = self._fits[name], sight.time_ns
        span_ns = pair[-1].time_ns - pair[0].time_ns
        difference, covariance, floor = np.zeros(6), np.zeros((6, 6)), np.zeros((6, 6))
        for other in pair:
            share = 1.0 - abs(time_ns - other.time_ns) / span_ns if span_ns else 1.0
            part, noise, lenses = _difference(other, sight, 1e-9 * (time_ns - other.time_ns),
                                              extrinsics)  # fmt: skip
            difference, floor = difference + share * part, floor + share * lenses
            covariance = covariance + share * noise
        twist = twist_at(sight.estimate, 0.0, sight.estimate.span)
        velocity = np.r_[twist.linear, twist.angular]
        # What is not known of the offset times that of the velocity, and the motion's curvature.
        off = fit.mean[6] ** 2 + fit.covariance[6, 6]
        expected = self._config.acceleration
        curved = np.repeat([expected.linear, expected.angular], 3) * 0.5 * off
        covariance = covariance + off * twist.covariance + np.diag(curved**2)
        if fit.add(time_ns, difference, velocity, covariance):
            fit.floor = floor
            self._conclude(name, fit)
        elif fit.contradicted >= _CHANGED:
            self._fits[name] = self._fresh()
            self._said = {said for said in self._said if said[1] != name}
            self._say(
                Notice.CLOCK, name,
                f"observations of {name} no longer agree with its extrinsics and clock: both are "
                "estimated again",
            )  # fmt: skip

    def _conclude(self, name: str, fit: _Fit) -> None:
        """Draw conclusions from one difference more."""
        reference = self._names[0]
        offset, deviation = float(fit.mean[6]), fit.offset_deviation
        self.values = self.values | {
            f"Extrinsics of {name} off by": fit.described(),
            f"Clock offset of {name} (ms)": f"{1e3 * offset:.2f} +- {1e3 * deviation:.2f}",
        }
        if fit.count >= _ENOUGH and abs(offset) > max(_SURELY_ONE * deviation, _LEAST_OFFSET):
            own = self._config.of_cameras[name].stamp_offset + offset
            self._say(
                Notice.CLOCK, name,
                f"the clock of {name} is {1e3 * offset:.2f} +- {1e3 * deviation:.2f} ms off that "
                f"of {reference}: set {name}.stamp_offset to {own:.5f}",
            )  # fmt: skip
        if fit.off:
            others = [other for other in self._fits.values() if other.count]
            is_reference = len(others) > 1 and all(other.off for other in others)
            named, to = (reference, "the others") if is_reference else (name, reference)
            text = f"extrinsics of {named} relative to {to} differ by {fit.described()}"
            self._say(Notice.EXTRINSICS, named, text)
            self.faults = self.faults | {str(Notice.EXTRINSICS): text}
        elif not any(other.off for other in self._fits.values()):
            self.faults = {}

    def _say(self, notice: Notice, name: str, text: str) -> None:
        if (notice, name) not in self._said:
            self._said.add((notice, name))
            self._notice(notice, text)


def _difference(
    other: _Sight, sight: _Sight, later: float, extrinsics: Transform
) -> tuple[Array, Array, Array]:
    """A camera's pose less what another camera says that is later by so many s.

    Returns:
        translation and turn (6,) in the camera's axes, their covariance (6,6), and that of what
        the lenses may be off by.
    """
    mounting = Mounting(extrinsics.inverse(), np.zeros(3), np.zeros(3))
    covariances = []
    for lenses in (False, True):
        known, alone = (
            it.estimate if lenses else replace(it.estimate, calibration_covariance=_NOTHING)
            for it in (other, sight)
        )
        predicted = base_pose(pose_at(known, later / known.span), mounting)
        pose = pose_at(alone, 0.0)
        axes = np.zeros((6, 6))
        axes[:3, :3] = axes[3:, 3:] = pose.rotation.T
        covariances.append(axes @ (predicted.covariance + pose.covariance) @ axes.T)
    turn = so3.log(np.ascontiguousarray(predicted.rotation.T @ pose.rotation))
    step = pose.rotation.T @ (pose.position - predicted.position)
    return np.r_[step, turn], covariances[0], covariances[1] - covariances[0]
