"""Frames of a camera whose readout time is not known: their motions have nothing in common, but
their map and their lens are the same.
"""

from __future__ import annotations

from numpy.typing import ArrayLike

from rs_localizer.core.types import Estimate, Failure
from rs_localizer.estimation.experience import Experience
from rs_localizer.localizer import Localizer


class ExperiencedFrames:
    """Localizes frames one by one and learns how far map and lens are off.

    A slightly wrong map looks like motion within a frame, now and then like much. Many frames tell
    which it is.
    """

    def __init__(self, localizer: Localizer) -> None:
        self._localizer = localizer
        self._experience: Experience | None = None

    def reset(self) -> None:
        """Forget all frames."""
        self._experience = None

    def localize(
        self, points: ArrayLike, pixels: ArrayLike, scores: ArrayLike | None = None
    ) -> Estimate | Failure:
        """As :meth:`Localizer.localize`."""
        before = self._experience
        found = self._localizer.localize(
            points, pixels, scores, None if before is None else before.prior
        )
        if found:
            self._experience = Experience.of(found) if before is None else before.and_of(found)
        return found
