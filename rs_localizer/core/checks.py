"""Values that people and files give, as the numbers they mean."""

from __future__ import annotations

import math
from collections.abc import Sequence
from enum import StrEnum
from numbers import Real
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from rs_localizer.core.arrays import Array

# NumPy's ArrayLike is so wide that type checkers take [[500, 0], [0, 500]] for a list of objects.
Matrix = NDArray[Any] | Sequence[Sequence[float]]
Vector = NDArray[Any] | Sequence[float]

E = TypeVar("E", bound=StrEnum)


def numbers(name: str, values: Any) -> Array:
    """An array of float64 of its own; ValueError for anything that is no number."""
    try:
        return np.array(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be numbers, got {values!r}") from None


def pixel_count(name: str, value: Any) -> int:
    """A whole number of pixels, also of a float as JSON has it (1280.0); otherwise ValueError."""
    if isinstance(value, Real) and not isinstance(value, bool):
        number = float(value)
        if math.isfinite(number) and number == math.floor(number):
            return int(number)
    raise ValueError(f"{name} must be a whole number of pixels, got {value!r}")


def choice(name: str, kind: type[E], value: Any) -> E:
    """One of the values of an enumeration; ValueError for any other."""
    try:
        return kind(value)
    except ValueError:
        raise ValueError(f"{name} must be one of {', '.join(kind)}; got {value!r}") from None
