"""The motion and the camera of ``rs_localizer simulate``: their options, and what they make."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path

import numpy as np

from rs_localizer import data
from rs_localizer.cli import UsageError
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.trajectories import read_tum
from rs_localizer.process.arguments import integer, number
from rs_localizer.settings import settings
from rs_localizer.simulation.frames import FrameSettings, frame_stamps
from rs_localizer.simulation.true_motion import (
    BODY_FROM_CAMERA,
    KNOT_SPACING,
    ConstantVelocity,
    RecordedMotion,
    TrueMotion,
    shaken,
)

# A still hand is no example: without any motion given, the camera turns and walks like this.
_ANGULAR_VELOCITY = (0.0, 1.0, 0.0)
_LINEAR_VELOCITY = (0.3, 0.0, 0.0)
_DURATION = 10.0
# A time of 0 means "none" to ROS.
_START_NS = 1_000_000_000
# The random numbers of a vibration are its own.
_STREAM = 60
# Stands for the bundled trajectory.
_BUNDLED = "tum_vi_room5"


def option(
    group: argparse._ArgumentGroup,
    name: str,
    kind: Callable[[str], float],
    default: float,
    unit: str,
    text: str = "",
) -> None:
    """An option with a number, whose help ends with its default."""
    said = f"{text} (default: %(default)s)".strip()
    group.add_argument(name, type=kind, default=default, metavar=unit, help=said)


def add_motion_arguments(group: argparse._ArgumentGroup) -> None:
    """Options that :func:`motion_of` and :func:`stamps_of` read."""
    group.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="follow recorded poses: TUM text, also .gz; gaps are left out, never bridged "
        f"({_BUNDLED}: the bundled motion of a hand-held rig)",
    )
    group.add_argument(
        "--axes",
        choices=sorted(BODY_FROM_CAMERA),
        default="forward_left_up",
        help="axes of the recorded body; the camera looks forward (default: %(default)s)",
    )
    group.add_argument(
        "--knot-spacing",
        type=number(0.0),
        default=KNOT_SPACING,
        metavar="S",
        help="seconds between the knots of the spline through recorded poses; 0: through every "
        "pose, shaking with its noise (default: %(default)s)",
    )
    group.add_argument(
        "--angular-velocity",
        type=number(),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="rad/s in camera axes (x right, y down, z forward) "
        f"(without any motion given: {_words(_ANGULAR_VELOCITY)})",
    )
    group.add_argument(
        "--linear-velocity",
        type=number(),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="m/s along the camera axes at the start "
        f"(without any motion given: {_words(_LINEAR_VELOCITY)})",
    )
    group.add_argument(
        "--vibration",
        type=number(0.0),
        nargs=2,
        metavar=("DEG", "HZ"),
        action="append",
        default=[],
        help="shake the camera besides, to and fro by DEG about any axis; may be repeated",
    )
    option(group, "--start", number(0.0), 0.0, "S", "seconds to skip")
    group.add_argument(
        "--duration",
        type=number(0.0, above=True),
        metavar="S",
        help=f"seconds (default: the whole trajectory; {_DURATION:g} at constant velocity)",
    )


def add_camera_arguments(group: argparse._ArgumentGroup) -> None:
    """Options that :func:`camera_of` and :func:`stamps_of` read."""
    option(group, "--width", integer(2), 640, "PX")
    option(group, "--height", integer(2), 480, "PX")
    option(group, "--focal", number(0.0, above=True), 500.0, "PX", "focal length")
    group.add_argument(
        "--distortion-model",
        choices=[model.value for model in DistortionModel],
        default=DistortionModel.PLUMB_BOB.value,
        help="(default: %(default)s)",
    )
    group.add_argument(
        "--distortion",
        type=number(),
        nargs="+",
        default=[],
        metavar="D",
        help="coefficients in the order of CameraInfo (default: none)",
    )
    longest = settings()["readout_time"].maximum or 0.0
    option(
        group, "--readout-time", number(0.0, longest), 0.03, "S", "from the first row to the last"
    )
    group.add_argument(
        "--scan-direction",
        choices=[direction.value for direction in ScanDirection],
        default=ScanDirection.TOP_TO_BOTTOM.value,
        help="(default: %(default)s)",
    )
    option(
        group, "--rate", number(0.0, above=True), FrameSettings().rate, "HZ", "frames per second"
    )


def camera_of(args: argparse.Namespace) -> Camera:
    """The camera; UsageError for a lens that cannot be."""
    K = np.array(
        [
            [args.focal, 0.0, 0.5 * (args.width - 1)],
            [0.0, args.focal, 0.5 * (args.height - 1)],
            [0.0, 0.0, 1.0],
        ]
    )
    try:
        return Camera(
            width=args.width,
            height=args.height,
            K=K,
            D=np.array(args.distortion),
            distortion_model=args.distortion_model,
            readout_time=args.readout_time,
            scan_direction=args.scan_direction,
        )
    except ValueError as error:  # the other arguments are checked already
        raise UsageError(f"--distortion: {error}") from error


def motion_of(args: argparse.Namespace) -> TrueMotion:
    """The recorded motion, or one at constant velocity, with its vibrations."""
    vibrations = [(degrees, hertz) for degrees, hertz in args.vibration]
    return shaken(_unshaken(args), vibrations, np.random.default_rng([args.seed, _STREAM]))


def _unshaken(args: argparse.Namespace) -> TrueMotion:
    velocities = (args.angular_velocity, args.linear_velocity)
    if args.trajectory is not None:
        if velocities != (None, None):
            raise UsageError("give either --trajectory or velocities, not both")
        file = args.trajectory
        if file == Path(_BUNDLED) and not file.exists():
            file = data.path(data.HAND_MOTION)
        return RecordedMotion(read_tum(file), args.axes, args.knot_spacing)
    angular, linear = velocities
    if angular is None and linear is None:
        angular, linear = _ANGULAR_VELOCITY, _LINEAR_VELOCITY
    return ConstantVelocity(
        np.array(angular or (0.0, 0.0, 0.0)),
        np.array(linear or (0.0, 0.0, 0.0)),
        args.start + (_DURATION if args.duration is None else args.duration),
        start_ns=_START_NS,
    )


def stamps_of(args: argparse.Namespace, camera: Camera, motion: TrueMotion) -> list[int]:
    """When the frames begin, ns; ValueError when there are none."""
    start_ns = motion.intervals_ns[0][0] + round(args.start * 1e9)
    stamps = [stamp for stamp in frame_stamps(motion, camera, args.rate) if stamp >= start_ns]
    if args.duration is not None:
        stamps = [stamp for stamp in stamps if stamp < start_ns + round(args.duration * 1e9)]
    if not stamps:
        raise ValueError("no frame lies within the motion, --start and --duration")
    return stamps


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)
