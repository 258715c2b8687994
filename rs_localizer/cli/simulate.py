# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer simulate``: a bag with ground truth of a simulated rolling-shutter camera."""

from __future__ import annotations

import argparse
import shlex
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from rs_localizer.cli import WORKING, UsageError, add_overwrite, integer, number, replaced
from rs_localizer.core.camera import Camera, DistortionModel
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import STORAGES, BagWriter
from rs_localizer.io.recording import MAP, MAP_FRAME, MARKER_MAP, PARAMETERS
from rs_localizer.settings import settings, write_parameters
from rs_localizer.simulation.settings import (
    BODY_FROM_CAMERA,
    FORMATS,
    KNOT_SPACING,
    Encoding,
    FrameSettings,
    ImageSettings,
    ImuSettings,
)
from rs_localizer.simulation.walls import SCENES, Scene

if WORKING:
    import numpy as np
    from numpy.typing import NDArray
    from tqdm import tqdm

    from rs_localizer import data
    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.maps.files import write_map_file
    from rs_localizer.io.maps.landmarks import Map
    from rs_localizer.io.rigs import RigParts, make_mounts, read_camchain
    from rs_localizer.io.topics import TF_STATIC
    from rs_localizer.io.trajectories import read_tum
    from rs_localizer.markers.map_files import write_marker_map
    from rs_localizer.simulation.frames import SimulatedFrame, frame_stamps, simulate_frames
    from rs_localizer.simulation.imu import ImuBagWriter, Lever, simulate_imu
    from rs_localizer.simulation.recording import write_rendered, write_simulated
    from rs_localizer.simulation.renderer import RenderedFrame, Renderer, rendered_frames
    from rs_localizer.simulation.rig import (
        Frame,
        camera_stamps,
        rig_parameters,
        simulate_rig,
        write_rig_frame,
    )
    from rs_localizer.simulation.scene import described, keypoint_rows, room
    from rs_localizer.simulation.true_motion import (
        ConstantVelocity,
        RecordedMotion,
        TrueMotion,
        sampled_states,
        shaken,
    )

# A still hand is no example: without any motion given, the camera turns and walks like this.
_ANGULAR_VELOCITY = (0.0, 1.0, 0.0)
_LINEAR_VELOCITY = (0.3, 0.0, 0.0)
_DURATION = 10.0
# A time of 0 means "none" to ROS.
_START_NS = 1_000_000_000
# The random numbers of a vibration are its own.
_VIBRATION_STREAM = 60
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


def add_rig_arguments(group: argparse._ArgumentGroup) -> None:
    """Options of a recording of several cameras."""
    group.add_argument(
        "--rig",
        type=Path,
        metavar="FILE",
        help="several cameras in place of one: Kalibr's camchain, with readout_time (s) and "
        "scan_direction of each camera besides",
    )
    group.add_argument(
        "--triggered",
        action="store_true",
        help="the cameras of --rig begin their images at once, instead of by clocks of their own",
    )


def rig_of(args: argparse.Namespace) -> RigParts:
    """The rig of ``--rig``; UsageError for what it does not go with."""
    if args.imu:
        raise UsageError("--imu is for one camera: leave it out with --rig")
    parts = read_camchain(args.rig)
    if unknown := [name for name, camera in parts.cameras.items() if camera.readout_time == 0.0]:
        raise UsageError(f"--rig: {args.rig} has no readout_time of {', '.join(unknown)}")
    return parts


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
            args.width, args.height, K, np.array(args.distortion), args.distortion_model,
            args.readout_time, args.scan_direction,
        )  # fmt: skip
    except ValueError as error:  # the other arguments are checked already
        raise UsageError(f"--distortion: {error}") from error


def motion_of(args: argparse.Namespace) -> TrueMotion:
    """The recorded motion, or one at constant velocity, with its vibrations."""
    rng = np.random.default_rng([args.seed, _VIBRATION_STREAM])
    return shaken(_unshaken(args), args.vibration, rng)


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


# Its random numbers are its own: the frames are the same with and without it.
_STREAM = 14
_OPTIONS = (
    "imu_rate",
    "gyroscope_noise",
    "gyroscope_bias",
    "gyroscope_bias_walk",
    "accelerometer_noise",
    "accelerometer_bias",
    "imu_offset",
)


def add_imu_arguments(group: argparse._ArgumentGroup) -> None:
    """Options that :func:`bag_of` reads."""
    imu = ImuSettings()
    group.add_argument(
        "--imu", action="store_true", help="write an IMU, too, and its mounting on /tf_static"
    )
    option(group, "--imu-rate", number(0.0, above=True), imu.rate, "HZ")
    option(group, "--gyroscope-noise", number(0.0), imu.gyroscope_noise, "N", "rad/s/sqrt(Hz)")
    option(group, "--gyroscope-bias", number(0.0), imu.gyroscope_bias, "B", "rad/s, any direction")
    option(
        group, "--gyroscope-bias-walk", number(0.0), imu.gyroscope_bias_walk, "N",
        "rad/s^2/sqrt(Hz)",
    )  # fmt: skip
    option(
        group, "--accelerometer-noise", number(0.0), imu.accelerometer_noise, "N",
        "m/s^2/sqrt(Hz)",
    )  # fmt: skip
    option(group, "--accelerometer-bias", number(0.0), imu.accelerometer_bias, "B", "m/s^2")
    option(
        group, "--imu-offset", number(), imu.time_offset, "S",
        "to add to its stamps to get the camera's time",
    )  # fmt: skip


def bag_of(args: argparse.Namespace, out: Path, motion: TrueMotion) -> BagWriter:
    """The recording that is written; with ``--imu`` one that holds its readings besides."""
    defaults = ImuSettings()
    settings = ImuSettings(*(getattr(args, name) for name in _OPTIONS))
    if not args.imu:
        if settings != defaults:
            raise UsageError("options of the IMU need --imu")
        return BagWriter(out, args.storage)
    lever = Lever()
    track = simulate_imu(motion, settings, lever, np.random.default_rng([args.seed, _STREAM]))
    return ImuBagWriter(out, args.storage, args.readout_time, track, settings, lever)


# Options of the one kind of recording that mean nothing to the other.
_OF_POINTS = ("points", "noise", "outliers", "keypoints")
_OF_IMAGES = ("walls", "exposure", "grey_noise", "vignetting", "format", "quality")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="bag directory to create")
    add_overwrite(parser)
    add_motion_arguments(parser.add_argument_group("motion"))
    add_camera_arguments(parser.add_argument_group("camera"))
    add_rig_arguments(parser.add_argument_group("rig"))
    add_imu_arguments(parser.add_argument_group("IMU"))
    frames = FrameSettings()
    points = parser.add_argument_group("what it sees: points")
    option(points, "--points", integer(1), frames.points, "N", "of a frame, if it sees so many")
    option(points, "--noise", number(0.0), frames.noise, "PX", "deviation of each raw coordinate")
    option(points, "--outliers", number(0.0, 1.0), frames.outliers, "SHARE", "of the points")
    points.add_argument(
        "--keypoints",
        action="store_true",
        help=f"pixels with binary descriptors, and the map beside them, {MAP}: for matching",
    )
    pictures, encoding = ImageSettings(), Encoding()
    images = parser.add_argument_group("what it sees: images")
    images.add_argument(
        "--images", action="store_true", help="render camera images, instead of points"
    )
    images.add_argument(
        "--walls",
        choices=list(SCENES),
        default=next(iter(SCENES)),
        help="three: walls of markers at right angles, with their map; "
        "poster, room: generated pictures; marked_room: with a few markers on its walls (default: "
        "%(default)s)",
    )
    option(images, "--exposure", number(0.0), pictures.exposure, "S", "of a row: motion blur")
    option(images, "--grey-noise", number(0.0), pictures.noise, "GREY", "deviation, of 255")
    option(
        images, "--vignetting", number(0.0, 1.0), pictures.vignetting, "SHARE",
        "of the light that the corners lose",
    )  # fmt: skip
    images.add_argument(
        "--format", choices=list(FORMATS), default=encoding.format, help="(default: %(default)s)"
    )
    option(images, "--quality", number(1.0, 100.0), encoding.quality, "PERCENT", "of JPEG")
    parser.add_argument(
        "--seed", type=integer(0), default=0, metavar="N",
        help="of all random numbers (default: %(default)s)",
    )  # fmt: skip
    parser.add_argument(
        "--storage", choices=list(STORAGES), default="mcap", help="(default: %(default)s)"
    )
    parser.set_defaults(defaults={
        name: parser.get_default(name) for name in (*_OF_POINTS, *_OF_IMAGES)
    })  # fmt: skip


def run(args: argparse.Namespace) -> dict[str, object]:
    foreign = _OF_POINTS if args.images else _OF_IMAGES
    foreign_options = [name for name in foreign if getattr(args, name) != args.defaults[name]]
    if foreign_options:
        option = f"--{foreign_options[0].replace('_', '-')}"
        raise UsageError(
            f"{option} is for points; images have --grey-noise and --exposure"
            if args.images
            else f"{option} is for images; give --images, too"
        )
    if args.rig is None and args.triggered:
        raise UsageError("--triggered is for --rig")
    write = _write_alone if args.rig is None else _write_rig
    return {"recording": str(args.out), **write(args)}


def _write_alone(args: argparse.Namespace) -> dict[str, object]:
    camera, motion = camera_of(args), motion_of(args)
    stamps, rng = stamps_of(args, camera, motion), np.random.default_rng(args.seed)
    world, counts = _world(args, motion, rng), list[int]()
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as built:
        with bag_of(args, built, motion) as bag:
            frames = _see(args, world, camera, motion, stamps)
            for frame in tqdm(frames, "simulate", len(stamps), unit="frame", disable=None):
                if isinstance(frame, RenderedFrame):
                    write_rendered(bag, camera, frame)
                else:
                    write_simulated(bag, camera, frame, _keypoints(args, world, frame, rng))
                    counts.append(len(frame.points))
        shutter = {"readout_time": args.readout_time, "scan_direction": args.scan_direction}
        _save(args, world, built, shutter, counts)
    what, lasted = "images" if args.images else "frames", (stamps[-1] - stamps[0]) * 1e-9
    said = f"{args.out}: {len(stamps)} {what} in {lasted:.1f} s"
    return {"images": len(stamps)} | _tell(args, world, said, counts)


def _write_rig(args: argparse.Namespace) -> dict[str, object]:
    parts, motion = rig_of(args), motion_of(args)
    some = stamps_of(args, next(iter(parts.cameras.values())), motion)
    stamps = {
        name: [stamp for stamp in all_ if some[0] <= stamp <= some[-1]]
        for name, all_ in camera_stamps(parts, motion, args.rate, args.seed, args.triggered).items()
    }
    rng, total = np.random.default_rng(args.seed), sum(map(len, stamps.values()))
    world, counts = _world(args, motion, rng), list[int]()

    def see(name: str, mounted: TrueMotion, place: int) -> Iterator[Frame]:
        return _see(args, world, parts.cameras[name], mounted, stamps[name], place)

    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as built:
        with BagWriter(built, args.storage) as bag:
            bag.write(TF_STATIC, make_mounts(parts), some[0])
            images = simulate_rig(parts, motion, see)
            for image in tqdm(images, "simulate", total, unit="image", disable=None):
                rows = None
                if isinstance(image.frame, SimulatedFrame):
                    rows = _keypoints(args, world, image.frame, rng)
                    counts.append(len(image.frame.points))
                write_rig_frame(bag, parts, motion, image, rows)
        _save(args, world, built, rig_parameters(parts), counts)
    said = f"{args.out}: {total} images of {', '.join(parts.cameras)}"
    figures = _tell(args, world, said, counts)
    return {"images": total, "cameras": list(parts.cameras)} | figures


def _world(args: argparse.Namespace, motion: TrueMotion, rng: np.random.Generator) -> Scene | Map:
    """What is around a motion: a scene to be rendered, or the landmarks of a room."""
    if args.images:
        return SCENES[args.walls](sampled_states(motion))
    ways = [
        motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 200)).positions
        for first, last in motion.intervals_ns
    ]
    return described(room(np.concatenate(ways), rng), MAP_FRAME, rng)


def _see(
    args: argparse.Namespace, world: Scene | Map, camera: Camera, motion: TrueMotion,
    stamps: list[int], place: int = 0,
) -> Iterator[Frame]:  # fmt: skip
    """What a camera sees; ``place`` is its own among the random numbers."""
    seed = args.seed + place
    if isinstance(world, Scene):
        pictures = ImageSettings(args.exposure, args.grey_noise, args.vignetting)
        renderer = Renderer(camera, world.planes, pictures)
        encoding = Encoding(args.format, round(args.quality))
        return rendered_frames(renderer, motion, stamps, encoding, seed)
    seen = FrameSettings(args.points, args.noise, args.outliers, args.rate)
    return simulate_frames(camera, motion, world.points, seen, stamps_ns=stamps, seed=seed)


def _keypoints(
    args: argparse.Namespace, world: Scene | Map, frame: SimulatedFrame, rng: np.random.Generator
) -> NDArray[Any] | None:
    """Rows in the place of correspondences, where they are wanted."""
    if args.keypoints and isinstance(world, Map):
        return keypoint_rows(frame, world, rng)
    return None


def _save(
    args: argparse.Namespace, world: Scene | Map, folder: Path, shutter: Mapping[str, Any],
    counts: list[int],
) -> None:  # fmt: skip
    """Write what a recording does not hold itself: the shutter, and the map."""
    if isinstance(world, Map) and not any(counts):
        raise ValueError(
            f"none of the {len(counts)} images sees any point; nothing is written to {args.out}"
        )
    write_parameters(folder / PARAMETERS, shutter)
    if isinstance(world, Scene):
        if world.marker_map is not None:
            write_marker_map(folder / MARKER_MAP, world.marker_map)
    elif args.keypoints:
        write_map_file(folder / MAP, world)


def _tell(
    args: argparse.Namespace, world: Scene | Map, said: str, counts: list[int]
) -> dict[str, object]:
    """Say what was written, and what comes next."""
    out = shlex.quote(str(args.out))
    if isinstance(world, Map):
        fewer = _fewer(counts, args.points) if args.rig is None else ""
        print(f"{said}, {np.mean(counts):.0f} points each{fewer}")
        words = f"--params {out}/{PARAMETERS}" + (f" --map {out}/{MAP}" if args.keypoints else "")
        print(f"next: rs_localizer replay {out} {words} --out {shlex.quote(f'{args.out}_poses')}")
        return {"points_per_image": float(np.mean(counts))}
    if world.marker_map is None:
        print(said)
        return {}
    print(f"{said}, {len(world.marker_map.markers)} markers on the walls")
    markers = shlex.quote(f"{args.out}_markers")
    print(f"next: rs_localizer detect {out} --map {out}/{MARKER_MAP} --out {markers}")
    return {"markers": len(world.marker_map.markers)}


def _fewer(counts: list[int], wanted: int) -> str:
    """What to add when some frames see fewer points than were asked for."""
    few, none = sum(count < wanted for count in counts), counts.count(0)
    if few == 0:
        return ""
    return f" (of {wanted} asked for; {few} frames see fewer, {none} of them none)"
