# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The kinds of arrays that pass through the package, and a check of what callers pass."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Random = NDArray[np.uint64]  # (1,), the state of a random generator of kernels
BoolArray = NDArray[np.bool_]


def instance(name: str, value: object, kind: type) -> None:
    """Raise ``ValueError``, saying what was passed, if it is not of a public class."""
    if not isinstance(value, kind):
        detail = f" ({value})" if type(value).__name__ == "Failure" else ""
        raise ValueError(
            f"{name} must be an rs_localizer.{kind.__name__}, got {type(value).__name__}{detail}"
        )
