"""Frames of which none predicts the next: with a gyroscope, or with memory of map and lens."""

from __future__ import annotations

from dataclasses import replace

from numpy.typing import ArrayLike

from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.experience import Experience
from rs_localizer.estimation.prior import Prior
from rs_localizer.inertial.aiding import GyroPrediction, GyroscopeAid
from rs_localizer.inertial.samples import ImuSamples
from rs_localizer.inertial.settings import InertialSettings
from rs_localizer.inertial.status import InertialStatus
from rs_localizer.localizer import Localizer


class SingleFrames:
    """Localizes frames as :class:`rs_localizer.tracking.Tracker` does, each from its image alone.

    Args:
        localizer: with a gyroscope, its camera must have a readout time.
        inertial: of the gyroscope; None: there is none. Its bias is what a gyroscope's may be, and
            the offset of its stamps the given one: only frame by frame either could be found.
        remembers: whether the frames tell the next ones how far map and lens are off. A slightly
            wrong map looks like motion within a frame, now and then like much; many frames tell
            which it is.
    """

    def __init__(
        self,
        localizer: Localizer,
        inertial: InertialSettings | None = None,
        remembers: bool = False,
    ) -> None:
        self._localizer = localizer
        # Logarithm of the odds for a global shutter, beside those of any.
        self.of_rest = 0.0
        self.remembers = remembers
        self._experience: Experience | None = None
        self._last: tuple[Estimate, int] | None = None  # and its time, ns
        self._aid: GyroscopeAid | None = None
        if inertial is not None:
            fixed = replace(inertial, estimate_time_offset=False)
            self._aid = GyroscopeAid(fixed, localizer.camera.readout_time)
            self._aid.warm_up()

    @property
    def inertial(self) -> InertialStatus | None:
        """What became of the gyroscope; None without one."""
        return None if self._aid is None else self._aid.status

    def reset(self) -> None:
        """Forget all frames."""
        self._experience, self._last = None, None

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
        if self._aid is None:
            return self._without_imu(time_ns, points, pixels, scores)

        def localized(foreseen: GyroPrediction | None) -> tuple[Estimate | Failure, Prior | None]:
            prior = None if foreseen is None else foreseen.prior
            turn = None if foreseen is None else foreseen.turn
            if turn is None and self.of_rest > 0.0:
                prior = replace(prior or Prior(), of_rest=self.of_rest)
            found = self._localizer.localize(points, pixels, scores, prior, turn=turn)
            return found, prior

        self._aid.reset()
        return self._aid.localize(imu, time_ns, lambda: None, localized)[0]

    def _without_imu(
        self, time_ns: int, points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None
    ) -> Estimate | Failure:
        if not self.remembers:
            return self._localizer.localize(points, pixels, scores, Prior(of_rest=self.of_rest))
        before, last = self._experience, self._last
        result = self._localizer.find(
            points, pixels, scores, None if before is None else before.prior
        )
        if result:
            after = Experience.of(result) if before is None else before.and_of(result)
            if before is not None and last is not None:
                seconds = 1e-9 * (time_ns - last[1])
                typical = self._localizer.config.velocity_prior
                after = after.moving(before.scales.speeds, last[0], result, seconds, typical)
            self._experience, self._last = after, (result, time_ns)
        return self._localizer.accepted(result)
