"""Whether the shutter moves over rows or over columns, from the frames themselves.

Drivers that rotate images turn the scan sideways and say nothing of it. The axis that is set and
the other one are compared by what their motions leave of each frame; the direction along the other
one comes from its motions from frame to frame (:mod:`rs_localizer.trajectory.online_readout`).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.core.types import Estimate, Failure
from rs_localizer.io.clouds import Correspondences
from rs_localizer.localizer import Localizer
from rs_localizer.solvers.table import find_solver
from rs_localizer.trajectory.online_readout import REVERSED, ReadoutMonitor
from rs_localizer.trajectory.readout_equations import MeasuredReadout

_OTHER_AXIS = {
    ScanDirection.TOP_TO_BOTTOM: ScanDirection.LEFT_TO_RIGHT,
    ScanDirection.BOTTOM_TO_TOP: ScanDirection.RIGHT_TO_LEFT,
    ScanDirection.LEFT_TO_RIGHT: ScanDirection.TOP_TO_BOTTOM,
    ScanDirection.RIGHT_TO_LEFT: ScanDirection.BOTTOM_TO_TOP,
}
# Logarithm of the likelihood ratio that one frame may contribute: errors of map and lens make a
# few of either sign in single frames (at most 13 in 360 simulated ones with the right axis, where
# the wrong one has a median of 5 to 160), and none shall decide alone.
_MOST_OF_A_FRAME = 4.0
# Of the sum, what is left one frame later: of two seconds at 30 Hz, a seventh.
_MEMORY = 0.97
# Odds of e^12 are enough to act, if the motion agrees; e^3 to doubt. Of odds the other way no more
# than e^4 is remembered: a camera that rests says little, and may start to move.
_CERTAIN, _DOUBT, _LEAST = 12.0, 3.0, -4.0
# Frames that are tried at the beginning, and when the axis that is set shows no motion; of others,
# every so many, as long as nothing speaks for the other axis.
_AT_FIRST, _SUSPECTED, _EVERY = 5, 40, 10
# Frames in which motion along the other axis has to agree; it takes 22 in a row for a measurement,
# and a few for odds of 100 that it agrees (see :mod:`rs_localizer.trajectory.shutter_hypotheses`).
_CHANCES, _AGREES, _CONTRADICTS = 40, 4.6, 2.0
# Frames from one measurement of the readout time to the next: it takes as long as some frames.
_MEASURED_EVERY = 5
# A readout time along the other axis counts when it is known to a twelfth, and more than half of
# the one that is set: of a real global shutter with errors of its lens, 5.1 +- 1.2 and 32.8 +- 3.0
# ms of 20 were seen.
_KNOWN, _LEAST_SHARE = 0.08, 0.5
# Residuals count up to this multiple of the inlier threshold.
_TRUNCATED = 2.0
_LEAST_NOISE = 0.1  # px


class ScanAxis:
    """Localizes frames along the other axis, too, until one of the axes is certain."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._localizer: Localizer | None = None
        self._monitor, self._monitored = ReadoutMonitor(), 0
        self._evidence = 0.0  # logarithm of the odds of the other axis
        self._dense = _AT_FIRST  # frames that are still to be tried, each
        self._skipped = 0  # since the last one that was
        self._suspected = self._confirmed = False
        # Along the other axis: how long the readout takes (positive), and its direction.
        self.measured: MeasuredReadout | None = None
        self.direction: ScanDirection | None = None

    @property
    def _leans(self) -> bool:
        """Whether frames fit the other axis better."""
        return self._evidence > _DOUBT

    @property
    def doubtful(self) -> bool:
        """Whether they do, and its motions do not contradict: errors of map and lens may do it."""
        early = self._monitored < _CHANCES and self._monitor.odds.rolling > -_CONTRADICTS
        return self._leans and (self.direction is not None or early)

    @property
    def wrong(self) -> bool:
        """Whether it must be the other axis: its motions also agree from frame to frame, which
        errors of map and lens do not.
        """
        return self._evidence > _CERTAIN and self.direction is not None

    @property
    def undecided(self) -> bool:
        """Whether it probably is the other axis: few motions agree yet."""
        agrees = self._monitor.odds.rolling > _AGREES
        return self._evidence > _CERTAIN and not self.wrong and agrees

    def suspect(self) -> None:
        """Look closely for a while: the axis that is set shows no motion."""
        if not self._suspected:
            self._suspected, self._dense = True, _SUSPECTED

    def confirm(self) -> None:
        """Look no more: the motion along the axis that is set agrees from frame to frame."""
        self._confirmed = not self._leans

    def add(
        self,
        config: NodeConfig,
        camera: Camera,
        time_ns: int,
        cloud: Correspondences,
        result: Estimate | Failure,
    ) -> None:
        """Compare a frame whose middle row was exposed at ``time_ns``.

        Args:
            config: the settings by which it was localized,
            camera: and the camera.
            cloud: what was localized,
            result: and what came of it.
        """
        self._skipped += 1
        due = self._leans or self._dense > 0 or self._skipped >= _EVERY
        if self._confirmed or not due:
            return
        self._skipped, self._dense = 0, self._dense - 1
        if not find_solver(config.solver).rolling_shutter:
            return
        if self._localizer is None:
            other = _OTHER_AXIS[ScanDirection(config.scan_direction)]
            self._localizer = Localizer(replace(camera, scan_direction=other), config)
        found = self._localizer.find(cloud.points, cloud.pixels, cloud.scores)
        ratio = _log_ratio(result, found, _TRUNCATED * config.inlier_threshold)
        ratio = min(max(ratio, -_MOST_OF_A_FRAME), _MOST_OF_A_FRAME)
        self._evidence = max(_MEMORY * self._evidence + ratio, _LEAST)
        if found and self._leans:
            self._measure(time_ns, found, cloud)

    def _measure(self, time_ns: int, estimate: Estimate, cloud: Correspondences) -> None:
        assert self._localizer is not None
        camera = self._localizer.camera
        lens = estimate.lens
        camera = camera if lens is None else lens.mended(camera)
        try:
            self._monitor.add(time_ns, camera, estimate, cloud.points, cloud.pixels)
            self._monitored += 1
            due = self._monitored % _MEASURED_EVERY == 0
            measured = self._monitor.measure() if due else None
        except np.linalg.LinAlgError:
            self._monitor.reset()
            return
        if measured is None or not measured.contradicts(0.0):
            return
        large = abs(measured.readout_time) > _LEAST_SHARE * camera.readout_time
        if not (large and measured.relative_deviation < _KNOWN):
            return
        direction = ScanDirection(camera.scan_direction)
        self.measured = replace(measured, readout_time=abs(measured.readout_time))
        self.direction = direction if measured.readout_time > 0.0 else REVERSED[direction]


def _log_ratio(ours: Estimate | Failure, other: Estimate | Failure, most: float) -> float:
    """Logarithm of the likelihood ratio of two results for the same points; positive: the other.

    Args:
        most: px, where residuals are cut off.
    """
    if not (ours or other):
        return 0.0
    of_both = [result for result in (ours, other) if result]
    count = len(of_both[0].inliers)
    noise = max(min(result.residual_rms for result in of_both) / np.sqrt(2.0), _LEAST_NOISE)

    def left(result: Estimate | Failure) -> float:
        if not result:
            return count * most**2
        cut = np.fmin(result.residuals, most)  # NaN: unusable by either
        return float(cut @ cut)

    return float((left(ours) - left(other)) / (2.0 * noise**2))
