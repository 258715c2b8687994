"""A comparison as a table of text."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from itertools import zip_longest

import numpy as np

from rs_localizer.core.arrays import Array
from rs_localizer.evaluation.comparison import Recording, Result
from rs_localizer.evaluation.metrics import Errors

_LABEL, _CELL = 44, 17
# What a row says of a method that has no such thing.
_NONE = "-"

Cell = Callable[[Recording, Result], str]


def table(title: str, recording: Recording, results: Mapping[str, Result]) -> str:
    """The results of several methods, by name, side by side; 80 columns hold two of them."""
    names = [textwrap.wrap(name, _CELL - 2) for name in results]
    lines = [
        f"{left:{_LABEL}}" + "".join(f"{part:>{_CELL}}" for part in parts)
        for left, *parts in zip_longest([title], *names, fillvalue="")
    ]
    for label, cell in _ROWS:
        cells = [cell(recording, result) for result in results.values()]
        if any(text != _NONE for text in cells):
            lines.append(f"  {label:{_LABEL - 2}}" + "".join(f"{text:>{_CELL}}" for text in cells))
    return "\n".join(lines)


def _localized(recording: Recording, result: Result) -> str:
    share = len(result.answers) / len(recording.stamps_ns)
    return f"{len(result.answers)} ({100.0 * share:.1f} %)"


def _latency(_: Recording, result: Result) -> str:
    if not result.answers:
        return _NONE
    p50, p95 = np.percentile(1e3 * result.latencies, [50, 95])
    return f"{p50:.1f} / {p95:.1f}"


def _pose_error(kind: Callable[[Errors], Array], digits: int, least_rate: float = 0.0) -> Cell:
    """Median over the frames in which the camera turns faster than ``least_rate`` (deg/s)."""

    def cell(_: Recording, result: Result) -> str:
        return _error(result.errors, kind, digits, least_rate)

    return cell


def _twist_error(kind: Callable[[Errors], Array], digits: int, least_rate: float = 0.0) -> Cell:
    def cell(_: Recording, result: Result) -> str:
        return _error(result.twist_errors, kind, digits, least_rate)

    return cell


def _error(
    errors: Errors | None, kind: Callable[[Errors], Array], digits: int, least_rate: float
) -> str:
    if errors is None:
        return _NONE
    values = kind(errors)
    chosen = values if least_rate == 0.0 else values[errors.true_angular_rate > least_rate]
    return _median(chosen, digits)


def _median(values: Array, digits: int) -> str:
    return f"{np.median(values):.{digits}f}" if len(values) else _NONE


def _millimetres(errors: Errors) -> Array:
    return np.multiply(1e3, errors.linear)


def _linear(errors: Errors) -> Array:
    return errors.linear


def _angular(errors: Errors) -> Array:
    return errors.angular


_ROWS: tuple[tuple[str, Cell], ...] = (
    ("frames", lambda recording, _: str(len(recording.stamps_ns))),
    ("localized", _localized),
    (
        "points in a frame, median",
        lambda recording, _: _median(np.array([float(c.width) for c in recording.clouds]), 0),
    ),
    ("inliers, median", lambda _, result: _median(result.inlier_counts, 0)),
    ("residual of the inliers, median (px rms)", lambda _, result: _median(result.residuals, 3)),
    ("position error, median (mm)", _pose_error(_millimetres, 1)),
    ("  where the camera turns > 60 deg/s", _pose_error(_millimetres, 1, 60.0)),
    ("  where the camera turns > 150 deg/s", _pose_error(_millimetres, 1, 150.0)),
    ("orientation error, median (deg)", _pose_error(_angular, 3)),
    ("  where the camera turns > 60 deg/s", _pose_error(_angular, 3, 60.0)),
    ("  where the camera turns > 150 deg/s", _pose_error(_angular, 3, 150.0)),
    ("angular velocity error, median (deg/s)", _twist_error(_angular, 1)),
    ("  where the camera turns > 150 deg/s", _twist_error(_angular, 1, 150.0)),
    ("linear velocity error, median (m/s)", _twist_error(_linear, 2)),
    ("latency, 50 / 95 % (ms)", _latency),
)
