# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of arrays that pass through the package, and checks of what callers pass."""

from numbers import Real
from typing import Annotated, TypeVar, cast

import numpy as np
from numpy.typing import NDArray

from rs_localizer.native.declared import WRITTEN, ArrayOf

T = TypeVar("T")

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

# Arguments of kernel entries: contiguous arrays with this number of dimensions.
Array1 = Annotated[Array, ArrayOf("float64", 1)]
Array2 = Annotated[Array, ArrayOf("float64", 2)]
Array3 = Annotated[Array, ArrayOf("float64", 3)]
Array4 = Annotated[Array, ArrayOf("float64", 4)]
IntArray1 = Annotated[IntArray, ArrayOf("int64", 1)]
IntArray2 = Annotated[IntArray, ArrayOf("int64", 2)]
IntArray3 = Annotated[IntArray, ArrayOf("int64", 3)]
BoolArray1 = Annotated[BoolArray, ArrayOf("bool", 1)]
ByteArray1 = Annotated[NDArray[np.uint8], ArrayOf("uint8", 1)]
ByteArray2 = Annotated[NDArray[np.uint8], ArrayOf("uint8", 2)]
WordArray1 = Annotated[NDArray[np.uint64], ArrayOf("uint64", 1)]
WordArray2 = Annotated[NDArray[np.uint64], ArrayOf("uint64", 2)]
SingleArray2 = Annotated[NDArray[np.float32], ArrayOf("float32", 2)]
SingleArray4 = Annotated[NDArray[np.float32], ArrayOf("float32", 4)]
SingleArray5 = Annotated[NDArray[np.float32], ArrayOf("float32", 5)]
# One that the kernel writes to.
Out = Annotated[T, WRITTEN]

Random = Out[WordArray1]
"""(1,), the state of a random generator of kernels."""


def instance(name: str, value: object, kind: type) -> None:
    """Raise ``ValueError``, saying what was passed, if it is not of this class."""
    if not isinstance(value, kind):
        detail = f" ({value})" if type(value).__name__ == "Failure" else ""
        raise ValueError(
            f"{name} must be of type {kind.__name__}, got {type(value).__name__}{detail}"
        )


_MOST = np.finfo(float).max


def real(name: str, value: object, kind: str, low: float = -_MOST, high: float = _MOST) -> None:
    """Raise ``ValueError``, saying what was passed, unless ``low <= value <= high``."""
    known = isinstance(value, Real) or (isinstance(value, np.ndarray) and value.ndim == 0)
    try:
        inside = known and low <= float(cast("float", value)) <= high
    except (TypeError, OverflowError):  # of a duration, or as large as no float is
        inside = False
    if not inside:
        raise ValueError(f"{name} must be {kind}, got {value!r}")


def whole_ns(time_ns: object) -> int:
    """Return a time as Python's integer, of any type of integer; ``ValueError`` for others.

    Differences of NumPy's unsigned integers would wrap around.
    """
    if isinstance(time_ns, bool) or not isinstance(time_ns, (int, np.integer)):
        raise ValueError(
            f"time_ns must be a whole number of nanoseconds, got {time_ns!r} "
            f"({type(time_ns).__name__}): round(1e9 * seconds)"
        )
    return int(time_ns)
