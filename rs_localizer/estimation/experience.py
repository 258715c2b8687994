"""What the frames so far say of shaking and of errors of map and lens: the next ones share them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from rs_localizer.core.arrays import Array
from rs_localizer.core.types import Estimate
from rs_localizer.estimation.prior import Prior

# What a frame says fades by this from frame to frame, and counts as part of what an independent
# frame would say: the next frame shows much the same.
_MEMORY = 0.95
_INDEPENDENT = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class Experience:
    """Logarithms of odds, as the fields of an :class:`Estimate` of these names."""

    of_shake_sizes: Array
    of_field_sizes: Array

    @classmethod
    def of(cls, first: Estimate) -> Self:
        """That of one frame."""
        return cls(first.of_shake_sizes, first.of_field_sizes)

    def and_of(self, newest: Estimate) -> Experience:
        """The experience after one more frame."""
        return Experience(
            _MEMORY * self.of_shake_sizes + _INDEPENDENT * newest.of_shake_sizes,
            _MEMORY * self.of_field_sizes + _INDEPENDENT * newest.of_field_sizes,
        )

    @property
    def prior(self) -> Prior:
        """For the next frame, of whose motion nothing is known."""
        return Prior(of_shake_sizes=self.of_shake_sizes, of_field_sizes=self.of_field_sizes)
