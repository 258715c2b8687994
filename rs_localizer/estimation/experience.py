"""What the frames so far say of shaking and of errors of map and lens: the next ones share them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.core.lens import LensError
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.lens import credible, joined, odds_of
from rs_localizer.estimation.prior import Prior

# What a frame says fades by this from frame to frame, and counts as part of what an independent
# frame would say: the next frame shows much the same.
_MEMORY = 0.95
_INDEPENDENT = 0.3
# A lens stays what it is, but two coefficients are not all of it: it is never known better than
# this (a tenth of a pixel at the corners of an image of 800 px across).
_LENS_MEMORY = 0.98
_LEAST_DEVIATION = 3e-4
# Logarithm of the odds beyond which a lens is taken to be off, and beyond which every frame is
# asked for it. Before, one in so many is, and where errors of map and lens are seen (the third of
# their sizes or more, by the logarithm of the odds for it).
_DECIDED, _ASKED = 10.0, 2.0
_EVERY = 16
_SEEN, _SUSPECTED = 2, 0.2


@dataclass(frozen=True, slots=True, eq=False)
class Experience:
    """Logarithms of odds, as the fields of an :class:`Estimate` of these names; and the lens."""

    of_shake_sizes: Array
    of_field_sizes: Array
    lens: LensError | None = None  # as it seems; None: nobody asked
    odds: float = 0.0  # for a lens that is off, logarithm
    frames: int = 1

    @classmethod
    def of(cls, first: Estimate) -> Self:
        """That of one frame."""
        odds = 0.0 if first.of_lens is None else odds_of(first.of_lens)
        return cls(first.of_shake_sizes, first.of_field_sizes, first.of_lens, odds)

    def and_of(self, newest: Estimate) -> Experience:
        """The experience after one more frame."""
        lens, odds, seen = self.lens, self.odds, newest.of_lens
        if seen is not None:
            lens = seen if lens is None else joined(lens, seen, _LENS_MEMORY)
            odds = odds_of(lens)
        elif self.odds > _DECIDED and newest.lens is None:  # the frame did without
            lens, odds = None, 0.0
        return Experience(
            _MEMORY * self.of_shake_sizes + _INDEPENDENT * newest.of_shake_sizes,
            _MEMORY * self.of_field_sizes + _INDEPENDENT * newest.of_field_sizes,
            lens,
            odds,
            self.frames + 1,
        )

    @property
    def prior(self) -> Prior:
        """For the next frame, of whose motion nothing is known."""
        prior = Prior(of_shake_sizes=self.of_shake_sizes, of_field_sizes=self.of_field_sizes)
        return self.with_lens(prior) or prior

    def with_lens(self, prior: Prior | None) -> Prior | None:
        """What is known of the next frame, and the lens if it is off."""
        if prior is None:
            return None
        if self.lens is not None and self.odds > _DECIDED and credible(self.lens):
            least = _LEAST_DEVIATION**2 * np.eye(len(self.lens.mean))
            lens = replace(self.lens, covariance=self.lens.covariance + least)
            return replace(prior, lens=lens)
        seen = self.of_field_sizes[_SEEN:].max(initial=0.0) > _SUSPECTED
        if seen or self.odds > _ASKED or self.frames % _EVERY == 0:
            return replace(prior, asks_lens=True)
        return prior
