# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer rectify``: images as a global shutter would have taken them."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from rs_localizer.cli import WORKING, UsageError, add_overwrite, replaced
from rs_localizer.cli.image_input import add_source_arguments, opened, shutter_values

if WORKING:
    import cv2
    import numpy as np
    from scipy.spatial.transform import Rotation
    from tqdm import tqdm

    from rs_localizer.core.arrays import Array
    from rs_localizer.core.shutter import Motion
    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.camera_info import read_camera_info
    from rs_localizer.io.images import Image, in_color
    from rs_localizer.io.maps.files import read_map_file
    from rs_localizer.io.trajectories import Trajectory, read_tum
    from rs_localizer.markers.map_files import read_marker_map
    from rs_localizer.offline.fleet.task import Figures
    from rs_localizer.offline.image_sources import Carried
    from rs_localizer.offline.rectified import (
        Depths,
        map_depths,
        motion_between,
        plane_depths,
        rectified,
    )
    from rs_localizer.settings import build

_FIRST, _LAST = "poses_first.txt", "poses_last.txt"
_LIST = "images.txt"  # the names of what was written
# Moments of rows are rounded to ns, twice.
_SAME_NS = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("images", type=Path, metavar="VIDEO|BAG|FOLDER", help="what was filmed")
    parser.add_argument(
        "--poses",
        type=Path,
        required=True,
        metavar="DIR",
        help="result of replay of the same images with --row first --row last (and --smooth), the "
        "camera's own: without base_frame",
    )
    parser.add_argument(
        "--depth",
        choices=("far", "plane", "map"),
        default="far",
        help="far: only the turn of the camera is undone (default); plane: of the points of --map; "
        "map: between its points",
    )
    parser.add_argument(
        "--map", type=Path, metavar="FILE", help="map of markers (.yaml) or of landmarks"
    )
    add_source_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, help="directory of PNG files to create")
    add_overwrite(parser)


def run(args: argparse.Namespace) -> Figures:
    if (args.depth == "far") != (args.map is None):
        raise UsageError("--depth plane and map need --map FILE, and --depth far none")
    config = build(shutter_values(args))
    if not config.readout_time:
        raise UsageError("give the readout time: --readout-time, --params of calibrate, or -p")
    depths = _depths(args)
    motions = _motions(args.poses, round(1e9 * config.stamp_offset))
    shares: dict[str, float] = {}
    total = 0
    with (
        opened(args, args.images, args.start) as source,
        atomic_directory(args.out, replaced(args, _LIST)) as out,
        tqdm(total=source.total, unit="image", desc="rectify", disable=None) as bar,
    ):
        out.mkdir()
        for shot in source.shots:
            if isinstance(shot, Carried):
                continue
            total += 1
            bar.update()
            if not isinstance(shot.image, Image):
                continue
            motion = motions(shot.image.stamp_ns)
            if motion is None:
                continue
            camera = read_camera_info(shot.camera_info).camera(
                config.readout_time, config.scan_direction
            )
            pixels = shot.image.pixels
            if shot.compressed is not None:
                pixels = in_color(shot.compressed, shot.image)  # where the image has any
            image, known = rectified(camera, pixels, motion, depths)
            name = f"{shot.image.stamp_ns}.png"
            (out / name).write_bytes(cv2.imencode(".png", image)[1].tobytes())
            shares[name] = float(known.mean())
        if not shares:
            raise ValueError(f"{args.poses} has no pose of the {total} images: other stamps?")
        (out / _LIST).write_text("".join(f"{name}\n" for name in shares), encoding="utf-8")
    known_share = float(np.mean(list(shares.values())))
    print(f"{args.out}: {len(shares)} of {total} images; the others have no pose")
    print(f"{1 - known_share:.1%} of their pixels are left black: no row has seen what is there")
    return {"images": total, "rectified": len(shares), "known": known_share}


def _depths(args: argparse.Namespace) -> Depths | None:
    if args.map is None:
        return None
    if args.map.suffix in (".yaml", ".yml"):
        points: Array = read_marker_map(args.map).points
    else:
        points = read_map_file(args.map, "map").points
    return plane_depths(points) if args.depth == "plane" else map_depths(points)


def _motions(folder: Path, offset_ns: int) -> Callable[[int], Motion | None]:
    """From the stamp of an image to the motion during its readout; None: there is no pose."""
    for name in (_FIRST, _LAST):
        if not (folder / name).is_file():
            raise ValueError(f"{folder} has no {name}: replay with --row first --row last")
    first, last = read_tum(folder / _FIRST), read_tum(folder / _LAST)
    if len(first) != len(last):
        raise ValueError(f"{folder}: {_FIRST} and {_LAST} are of different images")
    ends = list(zip(_poses(first), _poses(last), strict=True))
    stamps = first.stamps_ns - offset_ns

    def motion(stamp_ns: int) -> Motion | None:
        nearest = int(np.argmin(np.abs(stamps - stamp_ns)))
        if abs(int(stamps[nearest]) - stamp_ns) > _SAME_NS:
            return None
        return motion_between(*ends[nearest])

    return motion


def _poses(trajectory: Trajectory) -> Iterable[tuple[Array, Array]]:
    rotations = Rotation.from_quat(trajectory.quaternions).as_matrix()
    return zip(rotations, trajectory.positions, strict=True)
