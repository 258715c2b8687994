# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of arrays that pass through the package, and a check of what callers pass."""

from typing import Annotated, TypeVar

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
    """Raise ``ValueError``, saying what was passed, if it is not of a public class."""
    if not isinstance(value, kind):
        detail = f" ({value})" if type(value).__name__ == "Failure" else ""
        raise ValueError(
            f"{name} must be an rs_localizer.{kind.__name__}, got {type(value).__name__}{detail}"
        )
