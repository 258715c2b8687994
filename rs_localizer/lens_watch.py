# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Whether frames contradict what is said of lens and map: given deviations are promises.

What one frame leaves may be chance, what all of them leave is not. A lens that belongs to another
image before one wall is seen in some frames only: where the camera looks at it aslant. Before a
board none shows it, because motion takes up what it leaves; frames together do
(:mod:`.frames_together`).
"""

from __future__ import annotations

import math
import statistics
from collections import deque
from dataclasses import replace

import numpy as np

from rs_localizer.config import CalibrationErrors, LocalizerConfig
from rs_localizer.core import so3
from rs_localizer.core.arrays import Array
from rs_localizer.core.reasons import Reason
from rs_localizer.core.rig import Exposure
from rs_localizer.core.scanning import VERTICAL
from rs_localizer.core.state import ANGULAR, LINEAR, PARAMETERS, POSE, VELOCITIES
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.calibration import ErrorModes, LandmarkErrors
from rs_localizer.estimation.frames_together import FRAMES, Fitted, FramesTogether, Matrix
from rs_localizer.estimation.prior import predicted
from rs_localizer.localizer import Localizer

# Frames of which the median counts.
_FRAMES = 15
# Smooth errors are as large as they are declared to be to a factor of e; in so many of them.
_BEYOND = 4.5
# Of the distortion's deviation at the corners: what it leaves on average where motion takes up
# nothing. Of an ordinary one 0.3 px; surveyed tags before a calibrated lens have 0.2.
_OF_DISTORTION = 0.6
# So many of so many frames that another camera matrix explains are no chance: of twelve real boards
# none has one.
_OTHERS, _OF_THE_LAST = 2, 30
# Frames are compared again when an eighth more have come, each once; as soon as they tell the focal
# length, after as many as before, and after so many at most.
_SOON, _RARELY = 8, 192
# Intervals (s) over which a parabola is a hand's motion.
_LONGEST_INTERVAL = 0.15
# Beyond this (logarithm) fy over fx is not the image's, and no pose is told.
_MOST_SQUEEZED = 0.05


class LensWatch:
    """Compares smooth errors, and the motions between frames, with what is declared.

    Args:
        exposure: of a camera alone that moves while rows are read; None: motions are not compared.
        config: with the deviations of calibration and map.
    """

    def __init__(self, exposure: Exposure | None, config: LocalizerConfig) -> None:
        self._least = _OF_DISTORTION * config.calibration.distortion
        self._exposure, self._config = exposure, config
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._smooth = ""
        self._sizes: deque[tuple[float, float]] = deque(maxlen=_FRAMES)
        self._others: deque[str] = deque(maxlen=_OF_THE_LAST)
        self._posed: deque[Fitted] = deque(maxlen=FRAMES)
        self._together: FramesTogether | None = None
        self._other: Localizer | None = None  # with the matrix that frames tell, if they doubt K
        if self._exposure is not None:
            self._together = FramesTogether(self._exposure, self._config)
            self._allow_other(self._together)
        self._count, self._next, self._jumped = 0, FRAMES, False

    @property
    def matrix(self) -> Matrix | None:
        """The camera matrix that frames show instead of K; None: K may be right."""
        return None if self._together is None else self._together.matrix

    @property
    def fault(self) -> str:
        """How the last frames contradict what is declared, in one sentence."""
        if self.matrix is not None:
            return str(self.matrix)
        stretch = None if self._together is None else self._together.stretch
        return str(stretch) if stretch is not None and stretch.surely else self._smooth

    @property
    def refusal(self) -> str:
        """Why no pose can be told: K is that of another image."""
        if (matrix := self.matrix) is not None:
            off = abs(math.log(matrix.aspect_ratio)) > _MOST_SQUEEZED
            if off or matrix.focal_length != 1.0:
                return str(matrix)
        others = [text for text in self._others if text]
        return others[-1] if len(others) >= _OTHERS else ""

    @property
    def doubted(self) -> bool:
        """Whether K may be that of another camera."""
        return bool(self.refusal or (self._together and self._together.doubt.any()))

    @property
    def calibration(self) -> CalibrationErrors:
        """Deviations that allow for what frames do not tell of another matrix, if they doubt K."""
        given = self._config.calibration
        if self._together is None or self._together.other is None:
            return given
        _, deviations = self._together.other
        usual = given.focal_length, given.aspect_ratio, given.principal_point
        length, aspect, centre = np.hypot([*deviations[:2], deviations[2:].max()], usual).tolist()
        return replace(
            given,
            focal_length=min(length, 1.0),
            aspect_ratio=min(aspect, 1.0),
            principal_point=centre,
        )

    def errors_of(self, declared: ErrorModes | None) -> LandmarkErrors | None:
        """Return errors that landmarks share: those declared, and a stretch if frames show one."""
        stretch = None if self._together is None else self._together.stretch
        return declared if stretch is None else stretch._replace(beside=declared)

    def widened(self, found: Estimate, points: Array, pixels: Array) -> Estimate:
        """Return a frame that allows for another camera matrix, if frames doubt K.

        The motion that the other matrix gives is one deviation away. A wrong focal length scales
        the distance of a board, its tilt and all ways by one share, and so it does linear and
        angular velocities. A camera whose fy over fx is off by ``s`` reads that as a pitch rate of
        ``s`` times the height over the focal length.
        """
        if not (self._other and self._exposure and self._together) or self.refusal:
            return found
        camera, (length, aspect) = self._other.camera, self._together.doubt[:2].tolist()
        (given,) = self._exposure.cameras
        axis = int(camera.scan_direction not in VERTICAL)
        depth = float(np.median(points @ found.rotation[2])) + found.translation[2]
        rate, speed = map(np.linalg.norm, (found.angular_velocity, found.linear_velocity))
        calibration = found.calibration_covariance.copy()
        calibration[ANGULAR, ANGULAR] += (length * rate) ** 2 * np.eye(3)
        calibration[ANGULAR, ANGULAR][axis, axis] += (
            aspect * camera.size[1 - axis] / camera.focal_length
        ) ** 2
        calibration[LINEAR, LINEAR] += length**2 * (speed**2 + (depth * rate) ** 2) * np.eye(3)
        # Near that, with velocities as they are known, and any pose.
        covariance = found.joint_covariance[:PARAMETERS, :PARAMETERS].copy()
        covariance[VELOCITIES, VELOCITIES] += calibration[VELOCITIES, VELOCITIES]
        covariance[POSE] = covariance[:, POSE] = 0.0
        np.fill_diagonal(covariance[POSE, POSE], np.inf)
        away = depth * (camera.focal_length / given.focal_length - 1.0)
        motion = replace(found, translation=found.translation + np.array([0.0, 0.0, away]))
        there = self._other.find(self._other.sights(points, pixels), predicted(motion, covariance))
        if there:
            turn = so3.log(np.ascontiguousarray(found.rotation @ there.rotation.T))
            off = np.r_[
                turn, found.rotation @ (there.position - found.position),
                there.angular_velocity - found.angular_velocity,
                there.linear_velocity - found.linear_velocity,
            ]  # fmt: skip
            calibration += np.outer(off, off)
        return replace(found, calibration_covariance=calibration)

    def add(
        self, time_ns: int, found: Estimate | Failure, points: Array, pixels: Array,
        *, jumped: bool = False,
    ) -> None:  # fmt: skip
        """Take a frame of a camera alone, whose middle row was exposed then, as it was found.

        ``jumped``: no camera goes there from the last frame, nor does a parabola.
        """
        if jumped and not self._jumped:  # who jumps on and on is seen wrongly, not moved
            self._posed.clear()
        self._jumped = jumped or (self._jumped and len(self._posed) < FRAMES)
        if not found:
            self._others.append(found.detail if found.reason is Reason.CALIBRATION else "")
            return
        self._others.append("")
        self._compare(Fitted(time_ns, found, points, pixels))
        if len(found.shake):  # vibration moves points smoothly, too
            return
        self._sizes.append((found.model_error, found.declared_error))
        if len(self._sizes) < _FRAMES:
            return
        off, declared = map(statistics.median, zip(*self._sizes, strict=True))
        allowed = self._allowed(declared)
        self._smooth = (
            f"residuals vary smoothly over the image ({off:.2g} px rms), more than the deviations "
            f"of calibration and map allow ({allowed:.2g} px): is the image of another mode or "
            "resolution, rectified or stabilized, or of another camera, or is the map off? "
            "Calibrate in the mode that is used, or set map_deviation"
            if off > allowed
            else ""
        )

    def _compare(self, frame: Fitted) -> None:
        """Compare the last frames with each other, now and then."""
        if self._together is None:
            return
        seconds = 1e-9 * (frame.time_ns - self._posed[-1].time_ns) if self._posed else 0.0
        if self._posed and not 0.0 < seconds < _LONGEST_INTERVAL:
            self._posed.clear()
        self._posed.append(frame)
        self._count += 1
        if len(self._posed) < FRAMES or self._count < self._next:
            return
        self._together.add(list(self._posed))
        self._allow_other(self._together)
        if self._together.is_enough:
            self._next = self._count + min(self._count, _RARELY)
        else:
            self._next = self._count + max(self._count // _SOON, FRAMES)

    def _allow_other(self, together: FramesTogether) -> None:
        other = together.other
        self._other = None if other is None else Localizer(other[0], self._config)

    def is_beyond(self, found: Estimate) -> bool:
        """Return whether one frame's smooth error is beyond what is declared."""
        return found.model_error > self._allowed(found.declared_error)

    def _allowed(self, declared: float) -> float:
        """Return the largest smooth error (px, rms) that deviations allow."""
        return max(_BEYOND * declared, self._least)
