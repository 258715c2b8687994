# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer simulate``: a bag with ground truth of a simulated rolling-shutter camera."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from rs_localizer.cli import WORKING, replaced
from rs_localizer.cli.options import UsageError, argument, option
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.calibration import pinhole_matrix, read_calibration
from rs_localizer.io.recording import MAP, MAP_FRAME, MARKER_MAP, PARAMETERS
from rs_localizer.settings import build, camera_values, settings, write_parameters
from rs_localizer.tools.simulation.settings import (
    FORMATS,
    Encoding,
    FrameSettings,
    ImageSettings,
    ImuSettings,
)
from rs_localizer.tools.simulation.walls import SCENES, Scene

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
    from rs_localizer.tools.simulation.frames import SimulatedFrame, frame_stamps, simulate_frames
    from rs_localizer.tools.simulation.imu import ImuBagWriter, Lever, simulate_imu
    from rs_localizer.tools.simulation.recording import write_rendered, write_simulated
    from rs_localizer.tools.simulation.renderer import RenderedFrame, Renderer, rendered_frames
    from rs_localizer.tools.simulation.rig import (
        Frame,
        camera_stamps,
        rig_parameters,
        simulate_rig,
        write_rig_frame,
    )
    from rs_localizer.tools.simulation.scene import described, keypoint_rows, room
    from rs_localizer.tools.simulation.true_motion import (
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
_FRAMES, _IMAGES, _ENCODING = FrameSettings(), ImageSettings(), Encoding()
_READOUT_TIME = 0.03  # s, of a webcam
_POSITIVE = (0.0, math.inf)


def _words(numbers: tuple[float, ...]) -> str:
    return " ".join(f"{number:g}" for number in numbers)


def rig_of(args: Options) -> RigParts:
    """The rig of ``--rig``; UsageError for what it does not go with."""
    for name in ("camera", "readout_time", "scan_direction", "imu", "imu_offset"):
        if getattr(args, name) != _DEFAULTS[name]:
            option = f"--{name.replace('_', '-')}"
            raise UsageError(f"{option} is for one camera: leave it out with --rig")
    assert args.rig is not None
    parts = read_camchain(args.rig)
    if unknown := [name for name, camera in parts.cameras.items() if camera.readout_time == 0.0]:
        raise UsageError(f"--rig: {args.rig} has no readout_time of {', '.join(unknown)}")
    return parts


def camera_of(args: Options) -> Camera:
    """The camera of ``--camera``, or a webcam; its shutter is what the options say."""
    lens = Camera(640, 480, pinhole_matrix(500.0, 500.0, 319.5, 239.5), readout_time=_READOUT_TIME)
    values = dict[str, Any]()
    if args.camera is not None:
        lens, values = read_calibration(args.camera), camera_values(args.camera)
    given = {"readout_time": args.readout_time, "scan_direction": args.scan_direction}
    values |= {name: value for name, value in given.items() if value is not None}
    config = build({"readout_time": lens.readout_time or _READOUT_TIME} | values)
    return replace(lens, readout_time=config.readout_time, scan_direction=config.scan_direction)


def motion_of(args: Options) -> TrueMotion:
    """The recorded motion, or one at constant velocity, with its vibrations."""
    rng = np.random.default_rng([args.seed, _VIBRATION_STREAM])
    return shaken(_unshaken(args), args.vibration, rng)


def _unshaken(args: Options) -> TrueMotion:
    velocities = (args.angular_velocity, args.linear_velocity)
    if args.trajectory is not None:
        if velocities != (None, None):
            raise UsageError("give either --trajectory or velocities, not both")
        file = args.trajectory
        if file == Path(_BUNDLED) and not file.exists():
            file = data.path(data.HAND_MOTION)
        return RecordedMotion(read_tum(file))
    angular, linear = velocities
    if angular is None and linear is None:
        angular, linear = _ANGULAR_VELOCITY, _LINEAR_VELOCITY
    return ConstantVelocity(
        np.array(angular or (0.0, 0.0, 0.0)),
        np.array(linear or (0.0, 0.0, 0.0)),
        args.start + (_DURATION if args.duration is None else args.duration),
        start_ns=_START_NS,
    )


def stamps_of(args: Options, camera: Camera, motion: TrueMotion) -> list[int]:
    """When the frames begin, ns; ValueError when there are none."""
    start_ns = motion.intervals_ns[0][0] + round(args.start * 1e9)
    stamps = [stamp for stamp in frame_stamps(motion, camera, args.rate) if stamp >= start_ns]
    if args.duration is not None:
        stamps = [stamp for stamp in stamps if stamp < start_ns + round(args.duration * 1e9)]
    if not stamps:
        raise ValueError("no frame lies within the motion, --start and --duration")
    return stamps


# Its random numbers are its own: the frames are the same with and without it.
_STREAM = 14


def bag_of(args: Options, out: Path, motion: TrueMotion, readout_time: float) -> BagWriter:
    """The recording that is written; with ``--imu`` one that holds its readings besides."""
    if not args.imu:
        if args.imu_offset:
            raise UsageError("--imu-offset needs --imu")
        return BagWriter(out)
    lever, settings = Lever(), ImuSettings(time_offset=args.imu_offset)
    track = simulate_imu(motion, settings, lever, np.random.default_rng([args.seed, _STREAM]))
    return ImuBagWriter(out, readout_time, track, settings, lever)


# Options of the one kind of recording that mean nothing to the other.
_OF_POINTS = ("points", "noise", "outliers", "keypoints")
_OF_IMAGES = ("walls", "exposure", "grey_noise", "format")


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """motion."""

    trajectory: Path | None = option(
        "follow recorded poses: TUM text, also .gz; gaps are left out, never bridged "
        f"({_BUNDLED}: the bundled motion of a hand-held rig)", "FILE",
    )  # fmt: skip
    angular_velocity: tuple[float, float, float] | None = option(
        "rad/s in camera axes (x right, y down, z forward) "
        f"(without any motion given: {_words(_ANGULAR_VELOCITY)})", "X Y Z",
    )  # fmt: skip
    linear_velocity: tuple[float, float, float] | None = option(
        "m/s along the camera axes at the start "
        f"(without any motion given: {_words(_LINEAR_VELOCITY)})", "X Y Z",
    )  # fmt: skip
    vibration: list[tuple[float, float]] = option(
        "add vibration by DEG about any axis; may be repeated", "DEG HZ",
        list, limits=_POSITIVE,
    )  # fmt: skip
    start: float = option("seconds to skip", "S", 0.0, limits=_POSITIVE)
    duration: float | None = option(
        f"seconds (default: the whole trajectory; {_DURATION:g} at constant velocity)", "S",
        limits=_POSITIVE, above=True,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """camera."""

    camera: Path | None = option(
        "lens and shutter, as calibrate writes it; or a calibration (default: 640x480, 500 px)",
        "FILE",
    )  # fmt: skip
    readout_time: float | None = option(
        f"from the first row to the last (default: that of the camera, or {_READOUT_TIME:g})", "S",
        limits=(0.0, settings()["readout_time"].maximum or 0.0),
    )  # fmt: skip
    scan_direction: str | None = option(
        "of the shutter (default: that of the camera, or top_to_bottom)",
        choices=[direction.value for direction in ScanDirection],
    )  # fmt: skip
    rate: float = option("frames per second", "HZ", _FRAMES.rate, limits=_POSITIVE, above=True)
    rig: Path | None = option(
        "several cameras in place of one: Kalibr's camchain, with readout_time (s) and "
        "scan_direction of each camera besides", "FILE",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ImuOptions:
    """IMU."""

    imu: bool = option("write an IMU, too, and its mounting on /tf_static", default=False)
    imu_offset: float = option("to add to its stamps to get the camera's time", "S", 0.0)


@dataclass(frozen=True, kw_only=True)
class Options(MotionOptions, CameraOptions, ImuOptions):
    out: Path = argument("bag directory to create", "OUT")
    overwrite: bool = option("replace an earlier result", default=False)
    points: int = option(
        "of a frame, if it sees so many", "N", _FRAMES.points, limits=(1, math.inf)
    )
    noise: float = option("deviation of each raw coordinate", "PX", _FRAMES.noise, limits=_POSITIVE)
    outliers: float = option("of the points", "SHARE", _FRAMES.outliers, limits=(0.0, 1.0))
    keypoints: bool = option(
        f"pixels with binary descriptors, and their map, {MAP}: for matching",
        default=False,
    )
    images: bool = option("render camera images, instead of points", default=False)
    walls: str = option(
        "of images; three: walls of markers at right angles, with their map; poster, room: "
        "generated pictures; marked_room: with a few markers on its walls",
        default=next(iter(SCENES)), choices=list(SCENES),
    )  # fmt: skip
    exposure: float = option(
        "of a row: motion blur of images", "S", _IMAGES.exposure, limits=_POSITIVE
    )
    grey_noise: float = option(
        "of images: deviation, of 255", "GREY", _IMAGES.noise, limits=_POSITIVE
    )
    format: str = option("of images", default=_ENCODING.format, choices=list(FORMATS))
    seed: int = option("of all random numbers", "N", 0, limits=(0, math.inf))


_DEFAULTS = {item.name: item.default for item in fields(Options)}


def run(args: Options) -> dict[str, object]:
    foreign = _OF_POINTS if args.images else _OF_IMAGES
    foreign_options = [name for name in foreign if getattr(args, name) != _DEFAULTS[name]]
    if foreign_options:
        option = f"--{foreign_options[0].replace('_', '-')}"
        raise UsageError(
            f"{option} is for points; images have --grey-noise and --exposure"
            if args.images
            else f"{option} is for images; give --images, too"
        )
    write = _write_alone if args.rig is None else _write_rig
    return {"recording": str(args.out), **write(args)}


def _write_alone(args: Options) -> dict[str, object]:
    camera, motion = camera_of(args), motion_of(args)
    stamps, rng = stamps_of(args, camera, motion), np.random.default_rng(args.seed)
    world, counts = _world(args, motion, rng), list[int]()
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as built:
        with bag_of(args, built, motion, camera.readout_time) as bag:
            frames = _see(args, world, camera, motion, stamps)
            for frame in tqdm(frames, "simulate", len(stamps), unit="frame", disable=None):
                if isinstance(frame, RenderedFrame):
                    write_rendered(bag, camera, frame)
                else:
                    write_simulated(bag, camera, frame, _keypoints(args, world, frame, rng))
                    counts.append(len(frame.points))
        shutter = {
            "readout_time": camera.readout_time,
            "scan_direction": str(camera.scan_direction),
        }
        _save(args, world, built, shutter, counts)
    what, lasted = "images" if args.images else "frames", (stamps[-1] - stamps[0]) * 1e-9
    said = f"{args.out}: {len(stamps)} {what} in {lasted:.1f} s"
    return {"images": len(stamps)} | _tell(args, world, said, counts)


def _write_rig(args: Options) -> dict[str, object]:
    parts, motion = rig_of(args), motion_of(args)
    some = stamps_of(args, next(iter(parts.cameras.values())), motion)
    stamps = {
        name: [stamp for stamp in all_ if some[0] <= stamp <= some[-1]]
        for name, all_ in camera_stamps(parts, motion, args.rate, args.seed).items()
    }
    rng, total = np.random.default_rng(args.seed), sum(map(len, stamps.values()))
    world, counts = _world(args, motion, rng), list[int]()

    def see(name: str, mounted: TrueMotion, place: int) -> Iterator[Frame]:
        return _see(args, world, parts.cameras[name], mounted, stamps[name], place)

    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as built:
        with BagWriter(built) as bag:
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


def _world(args: Options, motion: TrueMotion, rng: np.random.Generator) -> Scene | Map:
    """What is around a motion: a scene to be rendered, or the landmarks of a room."""
    if args.images:
        return SCENES[args.walls](sampled_states(motion))
    ways = [
        motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 200)).positions
        for first, last in motion.intervals_ns
    ]
    return described(room(np.concatenate(ways), rng), MAP_FRAME, rng)


def _see(
    args: Options, world: Scene | Map, camera: Camera, motion: TrueMotion,
    stamps: list[int], place: int = 0,
) -> Iterator[Frame]:  # fmt: skip
    """What a camera sees; ``place`` is its own among the random numbers."""
    seed = args.seed + place
    if isinstance(world, Scene):
        pictures = ImageSettings(args.exposure, args.grey_noise)
        renderer = Renderer(camera, world.planes, pictures)
        encoding = Encoding(args.format)
        return rendered_frames(renderer, motion, stamps, encoding, seed)
    seen = FrameSettings(args.points, args.noise, args.outliers, args.rate)
    return simulate_frames(camera, motion, world.points, seen, stamps_ns=stamps, seed=seed)


def _keypoints(
    args: Options, world: Scene | Map, frame: SimulatedFrame, rng: np.random.Generator
) -> NDArray[Any] | None:
    """Rows in the place of correspondences, where they are wanted."""
    if args.keypoints and isinstance(world, Map):
        return keypoint_rows(frame, world, rng)
    return None


def _save(
    args: Options, world: Scene | Map, folder: Path, shutter: Mapping[str, Any],
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


def _tell(args: Options, world: Scene | Map, said: str, counts: list[int]) -> dict[str, object]:
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
