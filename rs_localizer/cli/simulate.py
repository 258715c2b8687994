"""``rs_localizer simulate``: a bag with ground truth of a simulated rolling-shutter camera."""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer import data
from rs_localizer.cli import UsageError
from rs_localizer.core.camera import Camera, DistortionModel, ScanDirection
from rs_localizer.core.so3 import Array
from rs_localizer.io.bags import STORAGES, BagWriter
from rs_localizer.io.trajectories import read_tum
from rs_localizer.lab.recording import write_simulated
from rs_localizer.lab.scene import room
from rs_localizer.lab.simulation import FrameSettings, frame_stamps, simulate_frames
from rs_localizer.lab.true_motion import (
    BODY_FROM_CAMERA,
    KNOT_SPACING,
    ConstantVelocity,
    RecordedMotion,
    TrueMotion,
)

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
        type=float,
        default=KNOT_SPACING,
        metavar="S",
        help="seconds between the knots of the spline through recorded poses; 0: through every "
        "pose, shaking with its noise (default: %(default)s)",
    )
    motion.add_argument(
        "--angular-velocity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="rad/s in camera axes (x right, y down, z forward)",
    )
    motion.add_argument(
        "--linear-velocity",
        type=float,
        nargs=3,
        metavar=("X", "Y", "Z"),
        help="m/s along the camera axes at the start",
    )
    motion.add_argument("--start", type=float, default=0.0, metavar="S", help="seconds to skip")
    motion.add_argument(
        "--duration",
        type=float,
        metavar="S",
        help=f"seconds (default: the whole trajectory; {_DURATION:g} at constant velocity)",
    )
    camera = parser.add_argument_group("camera")
    camera.add_argument("--width", type=int, default=640)
    camera.add_argument("--height", type=int, default=480)
    camera.add_argument("--focal", type=float, default=500.0, metavar="PX")
    camera.add_argument(
        "--distortion-model",
        choices=[model.value for model in DistortionModel],
        default=DistortionModel.PLUMB_BOB.value,
    )
    camera.add_argument("--distortion", type=float, nargs="+", default=[], metavar="D")
    camera.add_argument(
        "--readout-time",
        type=float,
        default=0.03,
        metavar="S",
        help="seconds from the first row to the last (default: %(default)s)",
    )
    camera.add_argument(
        "--scan-direction",
        choices=[direction.value for direction in ScanDirection],
        default=ScanDirection.TOP_TO_BOTTOM.value,
    )
    seen = parser.add_argument_group("what it sees")
    seen.add_argument("--rate", type=float, default=frames.rate, metavar="HZ")
    seen.add_argument("--points", type=int, default=frames.points, help="points in each frame")
    seen.add_argument(
        "--noise", type=float, default=frames.noise, metavar="PX", help="of each raw coordinate"
    )
    seen.add_argument(
        "--outliers", type=float, default=frames.outliers, metavar="SHARE", help="from 0 to 1"
    )
    seen.add_argument("--seed", type=int, default=0)
    parser.add_argument("--storage", choices=list(STORAGES), default="mcap")


def run(args: argparse.Namespace) -> None:
    camera = Camera(
        width=args.width,
        height=args.height,
        K=np.array(
            [
                [args.focal, 0.0, 0.5 * (args.width - 1)],
                [0.0, args.focal, 0.5 * (args.height - 1)],
                [0.0, 0.0, 1.0],
            ]
        ),
        D=np.array(args.distortion),
        distortion_model=args.distortion_model,
        readout_time=args.readout_time,
        scan_direction=args.scan_direction,
    )
    settings = FrameSettings(args.points, args.noise, args.outliers, args.rate)
    motion = _motion(args)
    start_ns = motion.intervals_ns[0][0] + round(args.start * 1e9)
    stamps = [stamp for stamp in frame_stamps(motion, camera, args.rate) if stamp >= start_ns]
    if args.duration is not None:
        stamps = [stamp for stamp in stamps if stamp < start_ns + round(args.duration * 1e9)]
    if not stamps:
        raise ValueError("no frame lies within the motion, --start and --duration")
    map_points = room(_way(motion), np.random.default_rng(args.seed))
    points = 0
    with BagWriter(args.out, args.storage) as bag:
        frames = simulate_frames(
            camera, motion, map_points, settings, stamps_ns=stamps, seed=args.seed
        )
        for frame in tqdm(frames, total=len(stamps), unit="frame", desc="simulate", disable=None):
            write_simulated(bag, camera, frame)
            points += len(frame.points)
    print(
        f"{args.out}: {len(stamps)} frames in {(stamps[-1] - stamps[0]) * 1e-9:.1f} s, "
        f"{points / len(stamps):.0f} points each"
    )


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


def _way(motion: TrueMotion) -> Array:
    """Camera positions (n,3) all along a motion, for the room to be built around."""
    return np.concatenate(
        [
            motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 200)).positions
            for first, last in motion.intervals_ns
        ]
    )
