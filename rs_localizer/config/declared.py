"""A setting as it is declared: its default, what users are told of it, and its check."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import field, fields
from numbers import Integral, Real
from typing import Any


def setting(
    default: Any,
    description: str,
    *,
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] = (),
    read_only: bool = False,
    fixed: bool = False,
) -> Any:
    """A dataclass field with what a user needs to know of it.

    Args:
        default: its value, which also says its type.
        description: one line.
        minimum, maximum: of a number; they belong to the range.
        choices: of a text.
        read_only: it cannot be set while the node runs.
        fixed: it cannot be set after the node has been configured.
    """
    return field(
        default=default,
        metadata={
            "description": description,
            "minimum": minimum,
            "maximum": maximum,
            "choices": choices,
            "read_only": read_only,
            "fixed": fixed,
        },
    )


def check(config: Any, prefix: str = "") -> None:
    """Raise ``ValueError`` for the first setting whose type, range or choice is wrong."""
    for item in fields(config):
        if not item.metadata:
            continue
        name, value, default = prefix + item.name, getattr(config, item.name), item.default
        if isinstance(default, bool):
            valid = isinstance(value, bool)
        elif isinstance(default, int):
            valid = isinstance(value, Integral) and not isinstance(value, bool)
        elif isinstance(default, float):
            valid = isinstance(value, Real) and not isinstance(value, bool)
        elif isinstance(default, tuple):
            valid = _are_numbers(value, len(default))
        else:
            valid = isinstance(value, str)
        if not valid:
            raise ValueError(f"{name} must be {type_of(default)}, got {value!r}")
        choices = item.metadata["choices"]
        if choices and value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}; got {value!r}")
        low, high = item.metadata["minimum"], item.metadata["maximum"]
        if low is not None and not (low <= value <= high):
            raise ValueError(f"{name} must lie between {low} and {high}, got {value!r}")


def type_of(default: Any) -> str:
    """In words, what a setting with this default is."""
    if isinstance(default, tuple):
        return f"{len(default)} numbers, as {list(default)}"
    return f"of type {type(default).__name__}"


def _are_numbers(value: Any, count: int) -> bool:
    return (
        isinstance(value, Sequence)
        and len(value) == count
        and all(isinstance(item, Real) and math.isfinite(item) for item in value)
    )
