# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Types of command-line arguments: numbers that are refused where they make no sense."""

import argparse
import math
from collections.abc import Callable


def number(
    minimum: float = -math.inf, maximum: float = math.inf, *, above: bool = False
) -> Callable[[str], float]:
    """A finite number from ``minimum`` to ``maximum``, for ``add_argument(type=...)``.

    Args:
        above: the minimum itself is refused.
    """

    def parse(text: str) -> float:
        try:
            value = float(text)
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise argparse.ArgumentTypeError(f"must be a number, got {text!r}")
        if not minimum <= value <= maximum or (above and value == minimum):
            raise argparse.ArgumentTypeError(f"{_range(minimum, maximum, above)}, got {text}")
        return value

    return parse


def integer(minimum: int) -> Callable[[str], int]:
    """A whole number that is not less than ``minimum``, for ``add_argument(type=...)``."""

    def parse(text: str) -> int:
        try:
            value = int(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"must be a whole number, got {text!r}") from None
        if value < minimum:
            raise argparse.ArgumentTypeError(f"must be {minimum} or more, got {text}")
        return value

    return parse


def _range(minimum: float, maximum: float, above: bool) -> str:
    if math.isfinite(maximum):
        return f"must lie between {minimum:g} and {maximum:g}"
    return f"must be more than {minimum:g}" if above else f"must be {minimum:g} or more"
