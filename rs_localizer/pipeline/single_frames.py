"""Frames that stand alone each, with what a gyroscope knows of the turn within them."""

from __future__ import annotations

from dataclasses import replace

from numpy.typing import ArrayLike

from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.prior import Prior
from rs_localizer.inertial.aiding import GyroPrediction, GyroscopeAid
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.status import InertialStatus
from rs_localizer.localizer import Localizer


class SingleFrames:
    """Localizes frames as :class:`rs_localizer.tracking.Tracker` does, but remembers none.

    The gyroscope's bias is what a gyroscope's may be, and the offset of its stamps the given one:
    only frame by frame either could be found.

    Args:
        localizer: its camera must have a readout time.
        inertial: of the gyroscope.
    """

    def __init__(self, localizer: Localizer, inertial: InertialSettings) -> None:
        self._localizer = localizer
        # Logarithm of the odds for a global shutter, beside those of any.
        self.of_rest = 0.0
        given = replace(inertial, estimate_time_offset=False)
        self._aid = GyroscopeAid(given, localizer.camera.readout_time)
        self._aid.warm_up()

    @property
    def inertial(self) -> InertialStatus:
        """What became of the gyroscope."""
        return self._aid.status

    def localize(
        self,
        time_ns: int,
        points: ArrayLike,
        pixels: ArrayLike,
        scores: ArrayLike | None = None,
        imu: ImuSamples | None = None,
    ) -> Estimate | Failure:
        """Localize the frame whose middle row was exposed at ``time_ns``.

        Arguments, result and errors otherwise as :meth:`Localizer.localize`.

        Args:
            imu: samples around the exposure; None: the camera goes alone.
        """

        def localized(foreseen: GyroPrediction | None) -> tuple[Estimate | Failure, Prior | None]:
            prior = None if foreseen is None else foreseen.prior
            turn = None if foreseen is None else foreseen.turn
            if turn is None and self.of_rest > 0.0:
                prior = replace(prior or Prior(), of_rest=self.of_rest)
            found = self._localizer.localize(points, pixels, scores, prior, turn=turn)
            return found, prior

        self._aid.reset()
        return self._aid.localize(imu, time_ns, lambda: None, localized)[0]
