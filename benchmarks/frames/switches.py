# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Parts of the estimator by name, each with what stands in its place while it is switched off.

Only here, by changing attributes of its modules: the package has no such switches. Kernels are
compiled with what they call, so that a switch is a Python function that a kernel is called from.
"""

import importlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.estimation.calibration import NO_EFFECT
from rs_localizer.estimation.left_out import LeftOut
from rs_localizer.estimation.linear_fit import nothing_shared


class Switch(NamedTuple):
    """An attribute ``module:name`` or ``module:class.name``, and what to put there for it."""

    place: str
    off: Callable[[Any], Any]


def _always(value: Any) -> Callable[[Any], Any]:
    """A function that returns this, whatever it is called with."""
    return lambda old: lambda *_args, **_known: value


def _with_posterior(**changed: Any) -> Callable[[Any], Any]:
    """The refusal by a posterior with other values."""
    return lambda old: (
        lambda posterior, *args, **known: old(posterior._replace(**changed), *args, **known)
    )


_FRAME = "rs_localizer.estimation.hypotheses"
_REFUSAL = "rs_localizer.localizer:refusal"

SWITCHES: dict[str, tuple[Switch, ...]] = {
    # Blocks of the model.
    "smooth-error": (
        Switch(f"{_FRAME}:smooth_errors",
               lambda old: lambda lines, inliers, *_: nothing_shared(int(inliers.sum()))),
    ),
    "in-frame-turn": (
        Switch(f"{_FRAME}:_with_turn", lambda old: lambda given, found, steady, asks: [steady]),
    ),
    "calibration-effect": (
        Switch("rs_localizer.localizer:calibration_effect", lambda old: lambda *args: old(
            *args)._replace(covariance=NO_EFFECT.covariance)),
    ),
    # Hypotheses.
    "typical-speeds": (
        Switch(f"{_FRAME}:speeds_of", lambda old: lambda assumed, _: old(assumed, True)),
    ),
    "grid-over-leans": (
        Switch(f"{_FRAME}:modes_at", lambda old: lambda *args: old(*args[:4], False, args[5])),
    ),
    "mixture-of-steady-and-vibrating": (
        Switch(f"{_FRAME}:_mixed", lambda old: lambda given, groups: old(given, [max(
            groups, key=lambda one: np.logaddexp.reduce(one.parts.evidences))])),
    ),
    # Refusals.
    "too-few": (
        Switch(_REFUSAL, lambda old: lambda *args, **known: old(
            *args, **(known | {"min_inliers": 0}))),
    ),
    "undetermined": (Switch(_REFUSAL, _with_posterior(smallest_eigenvalue=1.0)),),
    "uncertain": (Switch("rs_localizer.localizer:uncertain", _always(None)),),
    "own-motion": (Switch("rs_localizer.estimation.left_out:_own_motion", _always(None)),),
    "another-matrix": (
        Switch("rs_localizer.estimation.left_out:_of_another_lens", _always(None)),
    ),
    "by-chance": tuple(Switch(f"rs_localizer.{at}:by_chance", _always(None))
                       for at in ("localizer", "estimation.left_out")),
    "left-out": (Switch("rs_localizer.localizer:left_out", _always(LeftOut())),),
    # Tracking.
    "window": (Switch("rs_localizer.estimation.window:LENGTH", lambda old: 2),),
    "learnt-accelerations": (Switch("rs_localizer.estimation.window:_ROUNDS", lambda old: 0),),
}  # fmt: skip
"""By the name that ``python -m benchmarks.frames paired without NAME`` takes."""


def found(switch: Switch) -> tuple[Any, str, Any]:
    """The object that has a switch's attribute, the attribute's name, and its value.

    Raises:
        AttributeError, ModuleNotFoundError: the package has no such part.
    """
    module, _, path = switch.place.partition(":")
    holder: Any = importlib.import_module(module)
    *outer, name = path.split(".")
    for part in outer:
        holder = getattr(holder, part)
    return holder, name, getattr(holder, name)


@contextmanager
def switched_off(*names: str) -> Iterator[None]:
    """Within ``with``, the estimator lacks these parts."""
    before = [(found(switch), switch) for name in names for switch in SWITCHES[name]]
    try:
        for (holder, attribute, value), switch in before:
            setattr(holder, attribute, switch.off(value))
        yield
    finally:
        for (holder, attribute, value), _ in before:
            setattr(holder, attribute, value)
