# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Every setting of the package and its default; nothing else in the package repeats one.

The node declares its ROS parameters by walking these classes, so the names, descriptions and
ranges here are what users see in ``ros2 param describe``.
"""

from __future__ import annotations

import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from enum import StrEnum
from numbers import Integral, Real
from typing import Any, ClassVar

from rs_localizer.core.scanning import ScanDirection
from rs_localizer.solvers.table import SOLVERS

NO_NAMES = ("",)
"""A list of names without any: ROS cannot tell the type of an empty one."""


@dataclass(frozen=True, slots=True)
class Setting:
    """One setting: its default and what users are told of it."""

    default: Any
    description: str
    minimum: float | None
    maximum: float | None
    choices: tuple[str, ...]
    read_only: bool
    fixed: bool  # once the node is configured


def setting(
    default: Any,
    description: str,
    limits: tuple[float | None, float | None] = (None, None),
    choices: tuple[str, ...] = (),
    *,
    read_only: bool = False,
    fixed: bool = False,
) -> Any:
    """Declare a dataclass field, with what a user needs to know of the setting.

    Args:
        default: its value, which also says its type; a member of an enumeration: one of its texts.
        description: one line.
        limits: minimum and maximum of a number, which may have these values.
        choices: of a text.
        read_only: it cannot be set while the node runs.
        fixed: it cannot be set after the node has been configured.
    """
    if isinstance(default, StrEnum):
        default, choices = default.value, tuple(item.value for item in type(default))
    about = Setting(default, description, *limits, choices, read_only, fixed)
    return field(default=default, metadata={"setting": about})


# In descriptions of settings, as "Deviation of the time, in s; 0: unknown".
_UNIT = re.compile(r", in ([^\s;,]+)(?=[;,]|$)")


def check(config: Any, prefix: str = "") -> None:
    """Raise ``ValueError`` for the first setting whose type, range or choice is wrong.

    Numbers of other types, as 2 or ``np.float32(2)`` for 2.0, become those of the setting: kernels
    take no others.
    """
    for item in fields(config):
        if (about := item.metadata.get("setting")) is None:
            continue
        name, value, default = prefix + item.name, getattr(config, item.name), about.default
        if isinstance(default, bool):
            valid = isinstance(value, bool)
        elif isinstance(default, int):
            valid = isinstance(value, Integral) and not isinstance(value, bool)
        elif isinstance(default, float):
            valid = isinstance(value, Real) and not isinstance(value, bool)
        elif isinstance(default, tuple):
            valid = _are_texts(value) if default == NO_NAMES else _are_numbers(value, len(default))
        else:
            valid = isinstance(value, str)
        if not valid:
            raise ValueError(f"{name} must be {type_of(default)}, got {value!r}")
        if about.choices and value not in about.choices:
            raise ValueError(f"{name} must be one of {', '.join(about.choices)}; got {value!r}")
        low, high = about.minimum, about.maximum
        if low is not None and not (low <= value <= high):
            unit = _UNIT.search(about.description)
            unit_name = f" {unit[1]}" if unit else ""
            raise ValueError(f"{name} must lie between {low} and {high}{unit_name}, got {value!r}")
        if isinstance(default, (int, float)):
            object.__setattr__(config, item.name, type(default)(value))


def type_of(default: Any) -> str:
    """Describe in words the type of a setting with this default."""
    if default == NO_NAMES:
        return "names, as [front, rear]"
    if isinstance(default, tuple):
        return f"{len(default)} numbers, as {list(default)}"
    return f"of type {type(default).__name__}"


def _are_texts(value: Any) -> bool:
    return (
        isinstance(value, Sequence)
        and not isinstance(value, str)
        and all(isinstance(item, str) for item in value)
    )


def _are_numbers(value: Any, count: int) -> bool:
    return (
        isinstance(value, Sequence)
        and len(value) == count
        and all(isinstance(item, Real) and math.isfinite(item) for item in value)
    )


@dataclass(frozen=True, slots=True)
class _Checked:
    """Settings whose types, ranges and choices are checked when they are made."""

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        check(self, self.prefix)


# Of a velocity prior; anything less would hold the camera still with infinite force.
_LEAST_DEVIATION = 1e-6


@dataclass(frozen=True, slots=True)
class VelocityPrior(_Checked):
    """How fast cameras move: standard deviations of the zero-mean velocity prior.

    Robots, drones and hands; the points themselves show slower motion.
    """

    prefix = "velocity_prior."

    angular: float = setting(
        6.0, "Standard deviation of the angular velocity, in rad/s; 0: no prior", (0.0, 100.0)
    )
    linear: float = setting(
        3.0, "Standard deviation of the linear velocity, in m/s; 0: no prior", (0.0, 10000.0)
    )

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        for name in ("angular", "linear"):
            deviation = getattr(self, name)
            if 0.0 < deviation < _LEAST_DEVIATION:
                raise ValueError(
                    f"velocity_prior.{name} must be 0 (no prior) or at least {_LEAST_DEVIATION:g}, "
                    f"got {deviation!r}"
                )


@dataclass(frozen=True, slots=True)
class Acceleration(_Checked):
    """How fast cameras change their velocities, within a readout and from frame to frame."""

    prefix = "acceleration."

    angular: float = setting(
        10.0, "Standard deviation of the angular acceleration, in rad/s^2", (0.001, 10000.0)
    )
    linear: float = setting(
        4.0, "Standard deviation of the linear acceleration, in m/s^2", (0.001, 10000.0)
    )


@dataclass(frozen=True, slots=True)
class CalibrationErrors(_Checked):
    """Errors of the lens's calibration: parts that do not overlap.

    The defaults fit a board that was held before an ordinary camera for half a minute;
    ``rs_localizer calibrate`` writes its own deviations. For 1207 px of focal length and 0.3 px of
    noise, simulations show what the defaults cost. Before 150 points of a room, the principal point
    widens orientations from 0.006 to 0.039 deg. Positions of 0.2 mm become 2.2 mm by the focal
    length, 1.7 mm by the aspect ratio, and 0.4 mm by the distortion. Before a board of 0.6 m that
    is 2 m away, all defaults together add 7 %.
    """

    prefix = "calibration."

    principal_point: float = setting(
        1.0, "Standard deviation of the principal point, in pixels", (0.0, 1000.0)
    )
    focal_length: float = setting(
        0.002, "Standard deviation of the focal length, as a share of it", (0.0, 1.0)
    )
    distortion: float = setting(
        0.5, "Standard deviation of the distortion at the image's corners, in pixels", (0.0, 1000.0)
    )
    # What calibrations of phones and webcams scatter by; it looks like a turn across the rows.
    aspect_ratio: float = setting(
        0.003, "Standard deviation of fy over fx, as a share of it", (0.0, 1.0)
    )


class RefinementKind(StrEnum):
    """Ways to refine the best minimal sample of a frame."""

    NONE = "none"
    MOTION = "motion"
    FULL = "full"


@dataclass(frozen=True, slots=True)
class LocalizerConfig(_Checked):
    """Settings of one pose estimate (keyword arguments of :class:`rs_localizer.Localizer`)."""

    solver: str = setting(
        "r6p_vcwt", "Minimal solver that generates the hypotheses", choices=tuple(SOLVERS)
    )
    solver_iterations: int = setting(
        5, "Most iterations of an iterative solver; it stops when it converges", (1, 100)
    )
    refinement: str = setting(
        RefinementKind.FULL,
        "What follows the search; none: nothing, and no covariance; motion: least squares without "
        "priors; full: the posterior, which alone tracks frames",
    )
    inlier_threshold: float = setting(
        2.0,
        "Inlier threshold, in raw pixels; the gate is the larger of this and 3.5 standard "
        "deviations of the noise, at most twice this",
        (0.01, 1000.0),
    )
    max_iterations: int = setting(1000, "Most minimal samples of the motion search", (1, 1_000_000))
    confidence: float = setting(
        0.99, "Probability of a sample without outliers that ends the search", (0.0, 0.999999)
    )
    min_inliers: int = setting(8, "Fewest inliers of an accepted pose", (7, 1_000_000))
    seed: int = setting(0, "Seed of the random samples; every frame starts from it", (0, 2**31 - 1))
    velocity_prior: VelocityPrior = field(default_factory=VelocityPrior)
    acceleration: Acceleration = field(default_factory=Acceleration)
    calibration: CalibrationErrors = field(default_factory=CalibrationErrors)
    map_deviation: float = setting(
        0.0, "Standard deviation of the map's points, in m, shared by neighbours", (0.0, 1000.0)
    )

    def __post_init__(self) -> None:
        _Checked.__post_init__(self)
        for name, kind in (
            ("velocity_prior", VelocityPrior),
            ("acceleration", Acceleration),
            ("calibration", CalibrationErrors),
        ):
            if not isinstance(value := getattr(self, name), kind):
                raise ValueError(f"{name} must be of type {kind.__name__}, got {value!r}")


def meant(name: str, known: Sequence[str], otherwise: str = "") -> str:
    """Return the known name that an unknown one may stand for, as ``; did you mean it?``."""
    close = difflib.get_close_matches(name, known, n=1)
    if close:
        return f"; did you mean {close[0]}?"
    return f"; {otherwise} {', '.join(known)}" if otherwise else ""


def localizer_config(settings: Mapping[str, Any]) -> LocalizerConfig:
    """Return the settings of a localizer by keyword.

    Raises:
        ValueError: for a value out of range, or a name that is no setting; then with the one that
            may have been meant.
    """
    names = [item.name for item in fields(LocalizerConfig)]
    for name in settings:
        if name not in names:
            raise ValueError(
                f"{name!r} is not a setting of the localizer{meant(name, names, 'there are')}"
            )
    return LocalizerConfig(**settings)


class PoseTime(StrEnum):
    """The moment for which the pose is published."""

    STAMP = "stamp"
    MID_FRAME = "mid_frame"


class PublishTf(StrEnum):
    """Transform that is published on TF."""

    NONE = "none"
    MAP_TO_CAMERA = "map_to_camera"
    MAP_TO_ODOM = "map_to_odom"


class ImuUse(StrEnum):
    """Use of an IMU."""

    AUTO = "auto"
    NONE = "none"


@dataclass(frozen=True, slots=True)
class Imu(_Checked):
    """The IMU beside the camera, and how far it is believed."""

    prefix = "imu."

    use: str = setting(
        ImuUse.AUTO, "auto: if messages arrive and TF has its transform to the camera; none: never"
    )
    time_offset: float = setting(
        0.0, "Time to add to the stamps of the IMU to get the camera's time, in s", (-10.0, 10.0)
    )
    time_offset_deviation: float = setting(
        0.0,
        "Standard deviation of that before any frame has told, in s; 0: 0.02, or 0.002 where "
        "imu.time_offset is given",
        (0.0, 0.1),
    )
    scale_deviation: float = setting(
        0.03, "Standard deviation of the scale of the gyroscope's axes, a share", (1e-4, 0.5)
    )
    mount_deviation: float = setting(
        0.035, "Standard deviation of the rotation between IMU and camera, in rad", (1e-4, 0.5)
    )
    gyroscope_noise: float = setting(
        2e-4,
        "Least noise of the gyroscope, in rad/s/sqrt(Hz); more is learned",
        (1e-7, 1.0),
    )
    gyroscope_bias_walk: float = setting(
        1e-4, "Random walk of the gyroscope's bias, in rad/s^2/sqrt(Hz)", (0.0, 1.0)
    )
    gravity: bool = setting(
        False, "Use the direction of gravity that the accelerometer shows; needs gravity_in_map"
    )
    wait: float = setting(
        0.02, "Longest wait of a frame for the messages of its exposure, in s", (0.0, 1.0)
    )


@dataclass(frozen=True, slots=True)
class RigSettings(_Checked):
    """How the images of several cameras become frames."""

    prefix = "rig."

    window: float = setting(
        0.02,
        "Longest time between the middles of the exposures of one frame, in s; cameras without a "
        "common trigger need half their period",
        (0.0, 1.0),
    )


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings that each camera of a rig has of its own: ``NAME.readout_time`` and so on."""

    readout_time: float
    scan_direction: str
    stamp_offset: float


# A name stands in topics and before parameters.
_NAME = re.compile(r"[A-Za-z]\w*", re.ASCII)

LONGEST_READOUT_TIME = 0.2
"""Longest time from the first row to the last, in s."""


@dataclass(frozen=True, slots=True)
class NodeConfig(LocalizerConfig):
    """Settings of the node and of the offline replay: the localizer's, the shutter's, the times."""

    readout_time: float = setting(
        0.0,
        "Time from the first to the last row of the full sensor image, in s; 0: unknown, no twist",
        (0.0, LONGEST_READOUT_TIME),
    )
    readout_time_deviation: float = setting(
        0.0, "Standard deviation of readout_time, in s", (0.0, LONGEST_READOUT_TIME)
    )
    scan_direction: str = setting(
        ScanDirection.TOP_TO_BOTTOM, "Direction in which the shutter moves over the raw image"
    )
    stamp_offset: float = setting(
        0.0, "Time from header.stamp to mid-exposure of the first row, in s", (-10.0, 10.0)
    )
    pose_time: str = setting(
        PoseTime.STAMP,
        "stamp: the pose is of the input's stamp; mid_frame: pose and stamp are of the middle row",
    )
    tracking: bool = setting(
        True, "The frames before predict pose and twist; needs a readout_time and a solver for it"
    )
    output_lag: int = setting(
        0, "Frames for which a tracked result waits, which improve its twist", (0, 5)
    )
    output_rate: float = setting(
        0.0,
        "Rate of pose, twist and odometry, in Hz, predicted to now; 0: one output per image",
        (0.0, 1000.0),
    )
    max_prediction: float = setting(
        0.1, "Longest prediction after the last pose, for output_rate, in s", (0.0, 1.0)
    )
    max_points: int = setting(
        20_000,
        "Most points of a frame that are used: the best by score, or evenly over the image",
        (7, 1_000_000),
    )
    base_frame: str = setting(
        "",
        "Frame whose pose and twist are published; empty: the camera's own",
        fixed=True,
    )
    odom_frame: str = setting(
        "odom", "Frame of the odometry, for publish_tf map_to_odom", fixed=True
    )
    publish_tf: str = setting(
        PublishTf.NONE,
        "Transform to publish: map_to_camera: the body (base_frame if set) in the map; "
        "map_to_odom: REP-105, needs odometry on TF",
    )
    tf_rate: float = setting(
        20.0, "Rate of map_to_odom on TF, in Hz; 0: once per frame", (0.0, 1000.0)
    )
    hold: float = setting(
        0.0, "Longest time that map_to_odom is held without a pose, in s; 0: for ever", (0.0, 1e6)
    )
    two_d_mode: bool = setting(
        False, "Set z, roll and pitch of map_to_odom to zero, for robots on a floor"
    )
    transform_tolerance: float = setting(
        0.2,
        "Longest wait for a transform, and time by which map_to_odom is stamped ahead, in s",
        (0.0, 10.0),
    )
    camera_file: str = setting(
        "",
        "File of a camera by calibrate; its lens replaces that of camera_info, its settings count "
        "unless they are given otherwise; empty: none",
        read_only=True,
    )
    map_file: str = setting(
        "",
        "Map for keypoints: a .npz file or a sparse model of COLMAP; empty: map_points",
        fixed=True,
    )
    map_frame: str = setting("map", "Frame of the points in map_file", fixed=True)
    marker_map: str = setting("", "Marker map for the topic detections; empty: none", fixed=True)
    imu: Imu = field(default_factory=Imu)
    cameras: tuple[str, ...] = setting(
        NO_NAMES,
        "Cameras of a rig: each has its topics and its readout_time, scan_direction and "
        "stamp_offset below its name; without names there is one camera",
        read_only=True,
    )
    rig: RigSettings = field(default_factory=RigSettings)
    gravity_in_map: tuple[float, ...] = setting(
        (0.0, 0.0, -1.0), "Direction in which things fall in the map, of any length: imu.gravity"
    )
    autostart: bool = setting(True, "Configure and activate the node at start", read_only=True)
    # Of each of the cameras that have a name; empty: there is one, without.
    of_cameras: Mapping[str, CameraSettings] = field(default_factory=dict)

    def __post_init__(self) -> None:
        LocalizerConfig.__post_init__(self)
        self._check_cameras()
        if not any(self.gravity_in_map):
            raise ValueError("gravity_in_map must have a direction, got zeros")
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

    @property
    def shutters(self) -> Mapping[str, CameraSettings]:
        """The shutter of each camera and its stamps; of one without a name: ``""``."""
        own = CameraSettings(self.readout_time, self.scan_direction, self.stamp_offset)
        return self.of_cameras or {"": own}

    @property
    def is_timed(self) -> bool:
        """True if frames tell velocities; without a readout time they predict nothing."""
        rolling = SOLVERS[self.solver].rolling_shutter
        return rolling and all(own.readout_time > 0.0 for own in self.shutters.values())

    def _check_cameras(self) -> None:
        if self.cameras == NO_NAMES:
            return
        wrong = [name for name in self.cameras if not _NAME.fullmatch(name)]
        if wrong or not self.cameras or len(set(self.cameras)) < len(self.cameras):
            raise ValueError(
                "cameras must have different names of letters, digits and underscores, got "
                f"{', '.join(map(repr, self.cameras)) or 'none'}"
            )
        if set(self.of_cameras) != set(self.cameras):
            raise ValueError("of_cameras must have the settings of each of the cameras")
        for name, camera in self.of_cameras.items():
            if not 0.0 < camera.readout_time <= LONGEST_READOUT_TIME:
                raise ValueError(
                    f"{name}.readout_time must be above 0 and at most {LONGEST_READOUT_TIME:g} s, "
                    f"got {camera.readout_time!r}: a camera of a rig needs its own, or readout_time"
                )
            if camera.scan_direction not in tuple(ScanDirection):
                raise ValueError(
                    f"{name}.scan_direction must be one of {', '.join(ScanDirection)}; "
                    f"got {camera.scan_direction!r}"
                )
        if self.marker_map:
            raise ValueError("marker_map is for one camera: leave it out with cameras")


class ImageTransport(StrEnum):
    """Which image topic a detector listens to."""

    AUTO = "auto"
    RAW = "raw"
    COMPRESSED = "compressed"


@dataclass(frozen=True, slots=True)
class _ImageConfig(_Checked):
    """Settings of both detectors."""

    transport: str = setting(
        ImageTransport.AUTO,
        "Topic of the images; auto: image if it has a publisher, otherwise image/compressed",
        read_only=True,
    )
    autostart: bool = setting(True, "Configure and activate the node at start", read_only=True)


@dataclass(frozen=True, slots=True)
class DetectorConfig(_ImageConfig):
    """Settings of the marker detector."""

    marker_map: str = setting(
        "", "File of the marker map; rs_localizer markers make writes one with the prints"
    )


class FeatureKind(StrEnum):
    """How keypoints are found and described."""

    SIFT = "sift"
    ORB = "orb"
    AKAZE = "akaze"


@dataclass(frozen=True, slots=True)
class FeatureConfig(_ImageConfig):
    """Settings of the feature detector."""

    features: str = setting(
        FeatureKind.SIFT, "How keypoints are found and described; it has to be the map's"
    )
    max_keypoints: int = setting(
        1000, "Most keypoints of an image: the best ones of all its parts", (7, 1_000_000)
    )
