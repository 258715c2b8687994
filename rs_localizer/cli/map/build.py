"""``rs_localizer map build``: images of a room -> a map of landmarks, in metres."""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

from tqdm import tqdm

from rs_localizer.cli import UsageError, add_overwrite, replaced
from rs_localizer.cli.image_input import add_source_arguments
from rs_localizer.cli.map.build_images import Looked, Shutter, look_at_images, shutter_of
from rs_localizer.cli.map.build_imu import add_imu_arguments, imu_of
from rs_localizer.config import FeatureConfig
from rs_localizer.evaluation.map_pictures import save_pictures
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.maps.npz import write_npz
from rs_localizer.io.recording import MAP, MAP_FRAME, PARAMETERS
from rs_localizer.io.trajectories import Trajectory, write_tum
from rs_localizer.mapping.anchors import Anchors, Distance
from rs_localizer.mapping.build import Built, Given, Workshop, build_map
from rs_localizer.mapping.inertial_placing import GivenImu
from rs_localizer.mapping.report import rows, written
from rs_localizer.mapping.structure import Effort, require
from rs_localizer.mapping.views import Looker
from rs_localizer.markers.consistency import other_units
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.process.arguments import integer, number
from rs_localizer.settings import write_parameters

COLMAP, POSES, REPORT = "colmap", "poses.txt", "report.md"
# A hand's motion is held by so many images a second.
_IMAGES_PER_SECOND = 15.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "A map of landmarks from images: structure by COLMAP, refined with the rolling shutter."
    )
    parser.add_argument(
        "images", type=Path, metavar="VIDEO|BAG|FOLDER", help="images of one camera, as for detect"
    )
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="to create")
    scale = parser.add_argument_group("scale and place (default: the IMU of the bag)")
    scale.add_argument(
        "--markers", type=Path, metavar="FILE", help="marker map; some of it is in the images"
    )
    scale.add_argument(
        "--point",
        nargs=4,
        action=_Point,
        default=[],
        metavar=("NAME", "SECONDS", "U", "V"),
        help="a point in the first image at or after SECONDS from the start, by its raw pixel; "
        "each one in two images or more",
    )
    scale.add_argument(
        "--distance",
        nargs=3,
        action=_Distance,
        default=[],
        metavar=("NAME", "NAME", "METRES"),
        help="between two of these points",
    )
    add_imu_arguments(scale)
    add_source_arguments(parser)
    add_overwrite(parser)
    work = parser.add_argument_group("the work")
    work.add_argument(
        "--images-per-second",
        type=number(0.0, above=True),
        default=_IMAGES_PER_SECOND,
        metavar="N",
        help="of a video that are used, at most (default: %(default)g)",
    )
    work.add_argument(
        "--max-keypoints",
        type=integer(50),
        default=FeatureConfig().max_keypoints,
        metavar="N",
        help="of an image (default: %(default)s)",
    )
    work.add_argument(
        "--threads", type=integer(1), default=1, metavar="N",
        help="of COLMAP; with more than one, the last digits vary (default: %(default)s)",
    )  # fmt: skip
    work.add_argument("--seed", type=integer(0), default=0, metavar="N", help="(default: 0)")


def run(args: argparse.Namespace) -> None:
    if args.markers is not None and (args.point or args.distance):
        raise UsageError("give either --markers or --point and --distance")
    _check_points(args)
    require()
    if not args.images.exists():
        raise ValueError(f"{args.images} does not exist")
    markers = None if args.markers is None else _marker_map(args.markers)
    shutter, imu = shutter_of(args), imu_of(args)
    with atomic_directory(args.out, replaced(args, MAP)) as out:
        out.mkdir()
        looker = Looker(args.max_keypoints, markers)
        looked = look_at_images(args, looker, shutter.scan_direction)
        built = _build(
            args, looked, shutter, Anchors(markers, looked.points, tuple(args.distance)), imu, out
        )
        _write(out, built, looked)
    _tell(args, built, looked)


def _check_points(args: argparse.Namespace) -> None:
    """Before minutes of work: that each point of a distance is given in two images."""
    given = [name for name, *_ in args.point]
    if given and not args.distance:
        raise UsageError("--point says nothing without a --distance")
    for name in (end for distance in args.distance for end in (distance.one, distance.other)):
        if given.count(name) < 2:
            raise UsageError(
                f"--distance: the point {name} must be given by --point in two images or more, "
                f"it is in {given.count(name)}"
            )


def _marker_map(path: Path) -> MarkerMap:
    marker_map = read_marker_map(path)
    for fault in other_units(marker_map):
        print(f"warning: {path}: {fault}", file=sys.stderr)
    return marker_map


def _build(
    args: argparse.Namespace, looked: Looked, shutter: Shutter, anchors: Anchors,
    imu: GivenImu | None, out: Path,
) -> Built:  # fmt: skip
    markers = anchors.marker_map
    given = Given(
        looked.views,
        replace(looked.camera, readout_time=shutter.readout_time or 0.0),
        anchors,
        estimate_readout=shutter.readout_time is None,
        frame=MAP_FRAME if markers is None else markers.map_frame,
        imu=imu,
    )
    folder = out / COLMAP
    folder.mkdir()
    return build_map(given, Workshop(folder, Effort(args.threads, args.seed), _stage))


@contextmanager
def _stage(name: str, total: int) -> Iterator[Callable[[int], object]]:
    with tqdm(total=total, desc=name, disable=None) as bar:
        yield bar.update


def _write(out: Path, built: Built, looked: Looked) -> None:
    write_npz(out / MAP, built.landmarks)
    shutter = {
        "readout_time": built.camera.readout_time,
        "scan_direction": str(built.camera.scan_direction),
        "imu.time_offset": built.place.time_offset,
    }
    known = {name: value for name, value in shutter.items() if value is not None}
    write_parameters(out / PARAMETERS, known)
    stamps, positions, quaternions = built.middle_rows([view.stamp_ns for view in looked.views])
    write_tum(out / POSES, Trajectory(stamps, positions, quaternions), ["of the middle rows"])
    save_pictures(built, looked.views, out)
    (out / REPORT).write_text(written(built, looked.images, len(looked.views)), encoding="utf-8")


def _tell(args: argparse.Namespace, built: Built, looked: Looked) -> None:
    print(args.out / MAP)
    for name, text in rows(built, looked.images, len(looked.views)):
        print(f"  {name:30} {text}")
    if not built.placement.scaled:
        print(
            "warning: nothing tells the scale: poses and velocities are in units of the map; give "
            "--markers, --point and --distance, or --imu"
        )
    asked = built.refined.asked_readout
    if asked is not None and asked.differs:
        print(f"warning: {asked.told}")
    for doubt in (built.placement.doubt, *built.place.doubts):
        if doubt:
            print(f"warning: {doubt}")
    out = shlex.quote(str(args.out))
    print(
        "next, for images of another walk: rs_localizer detect IMAGES --features sift --out seen "
        f"&& rs_localizer replay seen --params {out}/{PARAMETERS} --map {out}/{MAP} --out poses"
    )


class _Point(argparse.Action):
    """NAME SECONDS U V."""

    def __call__(self, parser: Any, namespace: Any, values: Any, _: Any = None) -> None:
        name, *numbers = values
        given = (name, *(_number(self, text) for text in numbers))
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), given])


class _Distance(argparse.Action):
    """NAME NAME METRES."""

    def __call__(self, parser: Any, namespace: Any, values: Any, _: Any = None) -> None:
        one, other, text = values
        metres = _number(self, text)
        if not metres > 0.0 or one == other:
            raise argparse.ArgumentError(self, f"must be two points and metres, got {values}")
        given = Distance(one, other, metres)
        setattr(namespace, self.dest, [*getattr(namespace, self.dest), given])


def _number(action: argparse.Action, text: str) -> float:
    try:
        return number()(text)
    except argparse.ArgumentTypeError as error:
        raise argparse.ArgumentError(action, str(error)) from error
