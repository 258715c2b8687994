"""``rs_localizer simulate``: a bag with ground truth of a simulated rolling-shutter camera."""

from __future__ import annotations

import argparse
import shlex
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import UsageError, add_overwrite, replaced
from rs_localizer.cli.simulated_camera import (
    add_camera_arguments,
    add_motion_arguments,
    camera_of,
    motion_of,
    option,
    stamps_of,
)
from rs_localizer.cli.simulated_imu import add_imu_arguments, bag_of
from rs_localizer.core.arrays import Array
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import STORAGES
from rs_localizer.io.maps.files import write_map_file
from rs_localizer.io.recording import MAP, MAP_FRAME, MARKER_MAP, PARAMETERS
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.process.arguments import integer, number
from rs_localizer.settings import write_parameters
from rs_localizer.simulation.frames import FrameSettings, simulate_frames
from rs_localizer.simulation.image_sequence import FORMATS, Encoding, rendered_frames
from rs_localizer.simulation.landmarks import described, keypoint_rows
from rs_localizer.simulation.recording import write_rendered, write_simulated
from rs_localizer.simulation.renderer import ImageSettings, Renderer
from rs_localizer.simulation.scene import room
from rs_localizer.simulation.true_motion import TrueMotion, sampled_states
from rs_localizer.simulation.walls import SCENES

# Options of the one kind of recording that mean nothing to the other.
_OF_POINTS = ("points", "noise", "outliers", "keypoints")
_OF_IMAGES = ("walls", "exposure", "grey_noise", "vignetting", "format", "quality")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("out", type=Path, metavar="OUT", help="bag directory to create")
    add_overwrite(parser)
    add_motion_arguments(parser.add_argument_group("motion"))
    add_camera_arguments(parser.add_argument_group("camera"))
    add_imu_arguments(parser.add_argument_group("IMU"))
    frames = FrameSettings()
    seen = parser.add_argument_group("what it sees: points")
    option(seen, "--points", integer(1), frames.points, "N", "of a frame, if it sees so many")
    option(seen, "--noise", number(0.0), frames.noise, "PX", "deviation of each raw coordinate")
    option(seen, "--outliers", number(0.0, 1.0), frames.outliers, "SHARE", "of the points")
    seen.add_argument(
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


def run(args: argparse.Namespace) -> None:
    foreign = _OF_POINTS if args.images else _OF_IMAGES
    given = [name for name in foreign if getattr(args, name) != args.defaults[name]]
    if given:
        option = f"--{given[0].replace('_', '-')}"
        raise UsageError(
            f"{option} is for points; images have --grey-noise and --exposure"
            if args.images
            else f"{option} is for images; give --images, too"
        )
    if args.images:
        _write_images(args)
    else:
        _write_points(args)


def _write_points(args: argparse.Namespace) -> None:
    camera, motion = camera_of(args), motion_of(args)
    seen = FrameSettings(args.points, args.noise, args.outliers, args.rate)
    stamps = stamps_of(args, camera, motion)
    rng = np.random.default_rng(args.seed)
    landmarks = described(room(_way(motion), rng), MAP_FRAME, rng)
    counts: list[int] = []
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as built:
        with bag_of(args, built, motion) as bag:
            frames = simulate_frames(
                camera, motion, landmarks.points, seen, stamps_ns=stamps, seed=args.seed
            )
            total = len(stamps)
            for frame in tqdm(frames, total=total, unit="frame", desc="simulate", disable=None):
                if args.keypoints:
                    write_simulated(bag, camera, frame, keypoint_rows(frame, landmarks, rng))
                else:
                    write_simulated(bag, camera, frame)
                counts.append(len(frame.points))
        if not any(counts):
            raise ValueError(
                f"none of the {len(stamps)} frames sees any point; nothing is written to {args.out}"
            )
        write_parameters(built / PARAMETERS, _shutter(args))
        if args.keypoints:
            write_map_file(built / MAP, landmarks)
    print(
        f"{args.out}: {len(stamps)} frames in {(stamps[-1] - stamps[0]) * 1e-9:.1f} s, "
        f"{np.mean(counts):.0f} points each{_fewer(counts, args.points)}"
    )
    out = shlex.quote(str(args.out))
    poses = shlex.quote(f"{args.out}_poses")
    given = f"--params {out}/{PARAMETERS}"
    if args.keypoints:
        given += f" --map {out}/{MAP}"
    print(f"next: rs_localizer replay {out} {given} --out {poses}")


def _write_images(args: argparse.Namespace) -> None:
    camera, motion = camera_of(args), motion_of(args)
    stamps = stamps_of(args, camera, motion)
    scene = SCENES[args.walls](sampled_states(motion))
    settings = ImageSettings(args.exposure, args.grey_noise, args.vignetting)
    renderer = Renderer(camera, scene.planes, settings)
    encoding = Encoding(args.format, round(args.quality))
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as built:
        with bag_of(args, built, motion) as bag:
            frames = rendered_frames(renderer, motion, stamps, encoding, seed=args.seed)
            for frame in tqdm(frames, total=len(stamps), unit="frame", desc="render", disable=None):
                write_rendered(bag, camera, frame)
        write_parameters(built / PARAMETERS, _shutter(args))
        if scene.marker_map is not None:
            write_marker_map(built / MARKER_MAP, scene.marker_map)
    said = f"{args.out}: {len(stamps)} images in {(stamps[-1] - stamps[0]) * 1e-9:.1f} s"
    if scene.marker_map is None:
        print(said)
        return
    print(f"{said}, {len(scene.marker_map.markers)} markers on the walls")
    out = shlex.quote(str(args.out))
    found = shlex.quote(f"{args.out}_markers")
    print(f"next: rs_localizer detect {out} --map {out}/{MARKER_MAP} --out {found}")


def _shutter(args: argparse.Namespace) -> dict[str, object]:
    return {"readout_time": args.readout_time, "scan_direction": args.scan_direction}


def _fewer(counts: list[int], wanted: int) -> str:
    """What to add when some frames see fewer points than were asked for."""
    few, none = sum(count < wanted for count in counts), counts.count(0)
    if few == 0:
        return ""
    return f" (of {wanted} asked for; {few} frames see fewer, {none} of them none)"


def _way(motion: TrueMotion) -> Array:
    """Camera positions (n,3) all along a motion, for the room to be built around."""
    return np.concatenate(
        [
            motion.state(first, np.linspace(0.0, (last - first) * 1e-9, 200)).positions
            for first, last in motion.intervals_ns
        ]
    )
