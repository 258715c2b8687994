"""``rs_localizer simulate``: a bag with ground truth of a simulated rolling-shutter camera."""

from __future__ import annotations

import argparse
import shlex
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer import data
from rs_localizer.arguments import integer, number
from rs_localizer.cli import UsageError
from rs_localizer.core.camera import Camera, DistortionModel, ScanDirection
from rs_localizer.core.so3 import Array
from rs_localizer.io.bags import STORAGES, BagWriter
from rs_localizer.io.trajectories import read_tum
from rs_localizer.lab.recording import PARAMETERS, write_parameters, write_simulated
from rs_localizer.lab.scene import room
from rs_localizer.lab.simulation import FrameSettings, frame_stamps, simulate_frames
from rs_localizer.lab.true_motion import (
    BODY_FROM_CAMERA,
    KNOT_SPACING,
    ConstantVelocity,
    RecordedMotion,
    TrueMotion,
)
from rs_localizer.settings import settings

# A still hand is no example: without any motion given, the camera turns and walks like this.
_ANGULAR_VELOCITY = (0.0, 1.0, 0.0)
_LINEAR_VELOCITY = (0.3, 0.0, 0.0)
_DURATION = 10.0
# A time of 0 means "none" to ROS.
_START_NS = 1_000_000_000
# Stands for the bundled trajectory.
_BUNDLED = "tum_vi_room5"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    frames = FrameSettings()
    parser.add_argument("out", type=Path, metavar="OUT", help="bag directory to create")
    motion = parser.add_argument_group("motion")
    motion.add_argument(
        "--trajectory",
        type=Path,
        metavar="FILE",
        help="follow recorded poses: TUM text, also .gz; gaps are left out, never bridged "
        f"({_BUNDLED}: the bundled motion of a hand-held rig)",
    )
    motion.add_argument(
        "--axes",
        choices=sorted(BODY_FROM_CAMERA),
        default="forward_left_up",
        help="axes of the recorded body; the camera looks forward (default: %(default)s)",
    )
    motion.add_argument(
        "--knot-spacing",
        type=number(0.0),
        default=KNOT_SPACING,
        metavar="S",
        help="seconds between the knots of the spline through recorded poses; 0: through every "
        "pose, shaking with its noise (default: %(default)s)",
    )
    motion.add_argument(
        "--angular-velocity",
        type=number(),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="rad/s in camera axes (x right, y down, z forward) "
        f"(without any motion given: {_words(_ANGULAR_VELOCITY)})",
    )
    motion.add_argument(
        "--linear-velocity",
        type=number(),
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="m/s along the camera axes at the start "
        f"(without any motion given: {_words(_LINEAR_VELOCITY)})",
    )
    _option(motion, "--start", number(0.0), 0.0, "S", "seconds to skip")
    motion.add_argument(
        "--duration",
        type=number(0.0, above=True),
        metavar="S",
        help=f"seconds (default: the whole trajectory; {_DURATION:g} at constant velocity)",
    )
    camera = parser.add_argument_group("camera")
    _option(camera, "--width", integer(2), 640, "PX")
    _option(camera, "--height", integer(2), 480, "PX")
    _option(camera, "--focal", number(0.0, above=True), 500.0, "PX", "focal length")
    camera.add_argument(
        "--distortion-model",
        choices=[model.value for model in DistortionModel],
        default=DistortionModel.PLUMB_BOB.value,
        help="(default: %(default)s)",
    )
    camera.add_argument(
        "--distortion",
        type=number(),
        nargs="+",
        default=[],
        metavar="D",
        help="coefficients in the order of CameraInfo (default: none)",
    )
    longest = settings()["readout_time"].maximum or 0.0
    _option(
        camera, "--readout-time", number(0.0, longest), 0.03, "S", "from the first row to the last"
    )
    camera.add_argument(
        "--scan-direction",
        choices=[direction.value for direction in ScanDirection],
        default=ScanDirection.TOP_TO_BOTTOM.value,
        help="(default: %(default)s)",
    )
    seen = parser.add_argument_group("what it sees")
    _option(seen, "--rate", number(0.0, above=True), frames.rate, "HZ", "frames per second")
    _option(seen, "--points", integer(1), frames.points, "N", "of a frame, if it sees so many")
    _option(seen, "--noise", number(0.0), frames.noise, "PX", "deviation of each raw coordinate")
    _option(seen, "--outliers", number(0.0, 1.0), frames.outliers, "SHARE", "of the points")
    _option(seen, "--seed", integer(0), 0, "N", "of all random numbers")
    parser.add_argument(
        "--storage", choices=list(STORAGES), default="mcap", help="(default: %(default)s)"
    )


def _option(
    group: argparse._ArgumentGroup,
    name: str,
    kind: Callable[[str], float],
    default: float,
    unit: str,
    text: str = "",
) -> None:
    said = f"{text} (default: %(default)s)".strip()
    group.add_argument(name, type=kind, default=default, metavar=unit, help=said)


def run(args: argparse.Namespace) -> None:
    camera = _camera(args)
    seen = FrameSettings(args.points, args.noise, args.outliers, args.rate)
    motion = _motion(args)
    start_ns = motion.intervals_ns[0][0] + round(args.start * 1e9)
    stamps = [stamp for stamp in frame_stamps(motion, camera, args.rate) if stamp >= start_ns]
    if args.duration is not None:
        stamps = [stamp for stamp in stamps if stamp < start_ns + round(args.duration * 1e9)]
    if not stamps:
        raise ValueError("no frame lies within the motion, --start and --duration")
    map_points = room(_way(motion), np.random.default_rng(args.seed))
    counts: list[int] = []
    with BagWriter(args.out, args.storage) as bag:
        frames = simulate_frames(
            camera, motion, map_points, seen, stamps_ns=stamps, seed=args.seed
        )
        for frame in tqdm(frames, total=len(stamps), unit="frame", desc="simulate", disable=None):
            write_simulated(bag, camera, frame)
            counts.append(len(frame.points))
    if not any(counts):
        shutil.rmtree(args.out)
        raise ValueError(
            f"none of the {len(stamps)} frames sees any point; nothing is written to {args.out}"
        )
    write_parameters(args.out, args.readout_time, args.scan_direction)
    print(
        f"{args.out}: {len(stamps)} frames in {(stamps[-1] - stamps[0]) * 1e-9:.1f} s, "
        f"{np.mean(counts):.0f} points each{_fewer(counts, args.points)}"
    )
    out = shlex.quote(str(args.out))
    poses = shlex.quote(f"{args.out}_poses")
    print(f"next: rs_localizer replay {out} --params {out}/{PARAMETERS} --out {poses}")


def _fewer(counts: list[int], wanted: int) -> str:
    """What to add when some frames see fewer points than were asked for."""
    few, none = sum(count < wanted for count in counts), counts.count(0)
    if few == 0:
        return ""
    return f" (of {wanted} asked for; {few} frames see fewer, {none} of them none)"


def _camera(args: argparse.Namespace) -> Camera:
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


def _motion(args: argparse.Namespace) -> TrueMotion:
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


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def _way(motion: TrueMotion) -> Array:
    """Camera positions (n,3) all along a motion, for the room to be built around."""
    return np.concatenate(
        [
            motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 200)).positions
            for first, last in motion.intervals_ns
        ]
    )
