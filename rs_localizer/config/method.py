"""Settings of the method: what motions to expect, and how to search."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any

from rs_localizer.config.declared import check, setting
from rs_localizer.solvers.table import SOLVERS

# Of a velocity prior; anything less would hold the camera still with infinite force.
_LEAST_DEVIATION = 1e-6


@dataclass(frozen=True, slots=True)
class VelocityPrior:
    """How fast cameras move: standard deviations of the zero-mean velocity prior.

    Robots, drones and hands; what moves slower is told by the points.
    """

    angular: float = setting(
        6.0,
        "Standard deviation of the camera's angular velocity, in rad/s; 0: no prior",
        minimum=0.0,
        maximum=100.0,
    )
    linear: float = setting(
        3.0,
        "Standard deviation of the camera's linear velocity, in m/s; 0: no prior",
        minimum=0.0,
        maximum=10000.0,
    )

    def __post_init__(self) -> None:
        check(self, "velocity_prior.")
        for name in ("angular", "linear"):
            deviation = getattr(self, name)
            if 0.0 < deviation < _LEAST_DEVIATION:
                raise ValueError(
                    f"velocity_prior.{name} must be 0 (no prior) or at least {_LEAST_DEVIATION:g}, "
                    f"got {deviation!r}"
                )


@dataclass(frozen=True, slots=True)
class Acceleration:
    """How fast cameras change their velocities, within a readout and from frame to frame."""

    angular: float = setting(
        10.0,
        "Standard deviation of the camera's angular acceleration, in rad/s^2",
        minimum=0.001,
        maximum=10000.0,
    )
    linear: float = setting(
        4.0,
        "Standard deviation of the camera's linear acceleration, in m/s^2",
        minimum=0.001,
        maximum=10000.0,
    )

    def __post_init__(self) -> None:
        check(self, "acceleration.")


@dataclass(frozen=True, slots=True)
class CalibrationErrors:
    """What the calibration of the lens may be off by: parts of an error that do not overlap.

    The defaults are those of a board that was held before an ordinary camera for half a minute;
    ``rs_localizer calibrate`` writes those of its own.
    """

    principal_point: float = setting(
        1.0,
        "Standard deviation of the principal point, in pixels",
        minimum=0.0,
        maximum=1000.0,
    )
    focal_length: float = setting(
        0.002,
        "Standard deviation of the focal length, as a share of it",
        minimum=0.0,
        maximum=1.0,
    )
    distortion: float = setting(
        0.5,
        "Standard deviation of the distortion at the corners of the image, in pixels",
        minimum=0.0,
        maximum=1000.0,
    )

    def __post_init__(self) -> None:
        check(self, "calibration.")


@dataclass(frozen=True, slots=True)
class LocalizerConfig:
    """Settings of one pose estimate (keyword arguments of :class:`rs_localizer.Localizer`)."""

    solver: str = setting(
        "r6p_vcwt",
        "Minimal solver that generates the hypotheses",
        choices=tuple(SOLVERS),
    )
    solver_iterations: int = setting(
        5, "Iterations of the iterative linear solvers", minimum=1, maximum=100
    )
    inlier_threshold: float = setting(
        2.0,
        "Largest reprojection error of an inlier, in raw image pixels",
        minimum=0.01,
        maximum=1000.0,
    )
    max_iterations: int = setting(
        1000,
        "Most minimal samples of a frame, for its global-shutter start and again for its motion",
        minimum=1,
        maximum=1_000_000,
    )
    confidence: float = setting(
        0.99,
        "Probability of having drawn an all-inlier sample at which the search stops",
        minimum=0.0,
        maximum=0.999999,
    )
    min_inliers: int = setting(
        12, "Fewest inliers of a pose that is accepted", minimum=7, maximum=1_000_000
    )
    max_orientation_deviation: float = setting(
        0.07,
        "Largest standard deviation of the orientation of a pose that is accepted, in rad, about "
        "the axis known worst, of a camera at rest; three times as much of one that may move",
        minimum=0.001,
        maximum=10.0,
    )
    seed: int = setting(
        0, "Seed of the random samples; every frame starts from it", minimum=0, maximum=2**31 - 1
    )
    velocity_prior: VelocityPrior = field(default_factory=VelocityPrior)
    acceleration: Acceleration = field(default_factory=Acceleration)
    calibration: CalibrationErrors = field(default_factory=CalibrationErrors)
    map_deviation: float = setting(
        0.0,
        "How well the points of the map are known, in m (one standard deviation; neighbours are "
        "assumed to be off together); it widens covariances and gates",
        minimum=0.0,
        maximum=1000.0,
    )

    def __post_init__(self) -> None:
        check(self)
        for name, kind in (("velocity_prior", VelocityPrior), ("acceleration", Acceleration)):
            if not isinstance(getattr(self, name), kind):
                raise ValueError(
                    f"{name} must be of type {kind.__name__}, got {getattr(self, name)!r}"
                )


def localizer_config(settings: Mapping[str, Any]) -> LocalizerConfig:
    """The settings of a localizer by keyword.

    Raises:
        ValueError: for a value out of range, or a name that is no setting; then with the one that
            may have been meant.
    """
    names = [item.name for item in fields(LocalizerConfig)]
    for name in settings:
        if name not in names:
            close = difflib.get_close_matches(name, names, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(names)}"
            raise ValueError(f"{name!r} is not a setting of the localizer; {hint}")
    return LocalizerConfig(**settings)
