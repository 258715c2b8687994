"""Every setting of the package and its default; nothing else in the package repeats one.

The node declares its ROS parameters by walking these classes, so the names, descriptions and
ranges here are what users see in ``ros2 param describe``.
"""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from numbers import Integral, Real
from typing import Any

from rs_localizer.core.camera import ScanDirection
from rs_localizer.solvers.table import SOLVERS


class PoseTime(StrEnum):
    """The moment for which the pose is published."""

    STAMP = "stamp"
    MID_FRAME = "mid_frame"


class PublishTf(StrEnum):
    """What goes out on TF."""

    NONE = "none"
    MAP_TO_CAMERA = "map_to_camera"
    MAP_TO_ODOM = "map_to_odom"


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


def _check(config: Any, prefix: str = "") -> None:
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
        else:
            valid = isinstance(value, str)
        if not valid:
            raise ValueError(f"{name} must be of type {type(default).__name__}, got {value!r}")
        choices = item.metadata["choices"]
        if choices and value not in choices:
            raise ValueError(f"{name} must be one of {', '.join(choices)}; got {value!r}")
        low, high = item.metadata["minimum"], item.metadata["maximum"]
        if low is not None and not (low <= value <= high):
            raise ValueError(f"{name} must lie between {low} and {high}, got {value!r}")


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
        _check(self, "velocity_prior.")
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
        _check(self, "acceleration.")


class MatchBy(StrEnum):
    """What keypoints and landmarks are compared by."""

    AUTO = "auto"
    DESCRIPTOR = "descriptor"
    ID = "id"


@dataclass(frozen=True, slots=True)
class Matching:
    """How keypoints are matched with the landmarks of a map."""

    by: str = setting(
        MatchBy.AUTO.value,
        "What keypoints and landmarks are compared by; auto: descriptors if both have them, "
        "otherwise ids",
        choices=tuple(choice.value for choice in MatchBy),
    )
    ratio: float = setting(
        0.8,
        "A match by descriptor counts if its distance is below this part of the second-best "
        "landmark's; 1: always",
        minimum=0.01,
        maximum=1.0,
    )
    mutual: bool = setting(
        True, "A match by descriptor counts if no other keypoint is nearer to the landmark"
    )
    gate: float = setting(
        20.0,
        "While tracking, only landmarks predicted within this distance of a keypoint, in px, are "
        "compared with it by descriptor (more where the prediction is less certain); 0: all",
        minimum=0.0,
        maximum=10000.0,
    )
    max_keypoints: int = setting(
        2000,
        "Most keypoints of a frame to match by descriptor: those with the best scores, or the "
        "first ones",
        minimum=7,
        maximum=1_000_000,
    )

    def __post_init__(self) -> None:
        _check(self, "matching.")


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
    seed: int = setting(
        0, "Seed of the random samples; every frame starts from it", minimum=0, maximum=2**31 - 1
    )
    velocity_prior: VelocityPrior = field(default_factory=VelocityPrior)
    acceleration: Acceleration = field(default_factory=Acceleration)
    map_deviation: float = setting(
        0.0,
        "How well the points of the map are known, in m (one standard deviation; neighbours are "
        "assumed to be off together)",
        minimum=0.0,
        maximum=1000.0,
    )

    def __post_init__(self) -> None:
        _check(self)
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
    known = [item.name for item in fields(LocalizerConfig)]
    for name in settings:
        if name not in known:
            close = difflib.get_close_matches(name, known, n=1)
            hint = f"did you mean {close[0]!r}?" if close else f"there are {', '.join(known)}"
            raise ValueError(f"{name!r} is no setting of the localizer; {hint}")
    return LocalizerConfig(**settings)


LONGEST_READOUT_TIME = 0.2
"""What a camera may take from the first row to the last, in s."""


@dataclass(frozen=True, slots=True)
class NodeConfig(LocalizerConfig):
    """Settings of the node and of the offline replay: the localizer's, the shutter's, the times."""

    readout_time: float = setting(
        0.0,
        "Time from the first to the last row of the full sensor image, in s; "
        "0: unknown, then no twist is published",
        minimum=0.0,
        maximum=LONGEST_READOUT_TIME,
    )
    readout_time_deviation: float = setting(
        0.0,
        "Standard deviation of readout_time, in s, as rs_localizer calibrate finds it",
        minimum=0.0,
        maximum=LONGEST_READOUT_TIME,
    )
    estimate_readout_time: bool = setting(
        False,
        "Where readout_time is 0, find it and the scan direction from the camera's motion: after "
        "some seconds of it frames have twists and are tracked",
    )
    scan_direction: str = setting(
        ScanDirection.TOP_TO_BOTTOM.value,
        "Direction in which the shutter moves over the raw image",
        choices=tuple(direction.value for direction in ScanDirection),
    )
    stamp_offset: float = setting(
        0.0,
        "Time from header.stamp to the middle of the exposure of the first row, in s",
        minimum=-10.0,
        maximum=10.0,
    )
    pose_time: str = setting(
        PoseTime.STAMP.value,
        "stamp: the pose is valid at the input's stamp; mid_frame: the output's stamp is moved to "
        "the exposure of the middle row",
        choices=tuple(time.value for time in PoseTime),
    )
    tracking: bool = setting(
        True,
        "Use the previous pose and twist as first guess and prior; needs readout_time and a "
        "rolling-shutter solver",
    )
    base_frame: str = setting(
        "",
        "Frame of the body whose pose and twist are published, connected to the camera by TF; "
        "empty: the camera's optical frame",
        fixed=True,
    )
    odom_frame: str = setting(
        "odom", "Frame of the odometry, for publish_tf map_to_odom", fixed=True
    )
    publish_tf: str = setting(
        PublishTf.NONE.value,
        "Transform to publish: map_to_camera: the body (base_frame if set) in the map; "
        "map_to_odom: REP-105, needs odometry on TF",
        choices=tuple(choice.value for choice in PublishTf),
    )
    transform_tolerance: float = setting(
        0.2,
        "How long to wait for a transform that is not there yet, and how far map_to_odom is "
        "stamped into the future, in s",
        minimum=0.0,
        maximum=10.0,
    )
    map_file: str = setting(
        "",
        "Map that keypoints are matched with: a .npz or .ply file or a sparse model of COLMAP; "
        "empty: none, or the one published on map_points",
        fixed=True,
    )
    map_frame: str = setting("map", "Frame of the points in map_file", fixed=True)
    matching: Matching = field(default_factory=Matching)
    autostart: bool = setting(True, "Configure and activate the node at start", read_only=True)

    def __post_init__(self) -> None:
        LocalizerConfig.__post_init__(self)
        for name in ("base_frame", "odom_frame", "map_frame"):
            if getattr(self, name).startswith("/"):
                raise ValueError(
                    f"{name} must not start with '/' (TF's names do not), "
                    f"got {getattr(self, name)!r}"
                )
        for name in ("odom_frame", "map_frame"):
            if not getattr(self, name):
                raise ValueError(f"{name} must not be empty")
        if self.base_frame == self.odom_frame:
            raise ValueError(f"base_frame and odom_frame are both {self.odom_frame!r}")


class ImageTransport(StrEnum):
    """Which image topic the marker detector listens to."""

    AUTO = "auto"
    RAW = "raw"
    COMPRESSED = "compressed"


@dataclass(frozen=True, slots=True)
class DetectorConfig:
    """Settings of the marker detector."""

    marker_map: str = setting(
        "", "File of the marker map; rs_localizer markers make writes one with the prints"
    )
    min_side: float = setting(
        10.0,
        "Markers with a shorter side than this, in px, are left out",
        minimum=0.0,
        maximum=10000.0,
    )
    transport: str = setting(
        ImageTransport.AUTO.value,
        "Topic of the images; auto: image if it has a publisher, otherwise image/compressed",
        choices=tuple(transport.value for transport in ImageTransport),
        read_only=True,
    )
    readout_time: float = setting(
        0.0,
        "Only for the debug image: time from the first to the last row, in s, as the localizer's",
        minimum=0.0,
        maximum=0.2,
    )
    scan_direction: str = setting(
        ScanDirection.TOP_TO_BOTTOM.value,
        "Only for the debug image: direction in which the shutter moves, as the localizer's",
        choices=tuple(direction.value for direction in ScanDirection),
    )
    stamp_offset: float = setting(
        0.0,
        "Only for the debug image: time from header.stamp to the middle of the exposure of the "
        "first row, in s, as the localizer's",
        minimum=-10.0,
        maximum=10.0,
    )
    autostart: bool = setting(True, "Configure and activate the node at start", read_only=True)

    def __post_init__(self) -> None:
        _check(self)
