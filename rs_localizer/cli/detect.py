"""``rs_localizer detect``: images of markers or a board -> a recording for ``replay``."""

from __future__ import annotations

import argparse
import shlex
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import UsageError, many
from rs_localizer.cli.fleet import add_fleet_arguments, is_fleet
from rs_localizer.config import DetectorConfig
from rs_localizer.core.camera import Camera, ScanDirection
from rs_localizer.io.bags import STORAGES, is_bag, open_bag
from rs_localizer.io.calibration.files import CALIBRATION_KINDS, read_calibration
from rs_localizer.io.image_clock import DEFAULT_START_NS, ImageClock, readout_fault
from rs_localizer.io.recording import PARAMETERS
from rs_localizer.io.video import has_times
from rs_localizer.io.whole import told
from rs_localizer.markers.consistency import other_units
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Board, Chessboard, CircleGrid
from rs_localizer.offline.detect import Options, Recorded, record
from rs_localizer.offline.image_sources import (
    IMAGE_TYPES,
    INFO_TYPE,
    Carried,
    Shot,
    find_topic,
    from_bag,
    from_files,
    from_video,
    have_times,
    image_files,
)
from rs_localizer.pipeline.images import FrameDetector
from rs_localizer.process.arguments import number
from rs_localizer.settings import settings, write_parameters

_CHESSBOARD, _CIRCLES, _ASYMMETRIC = "chessboard", "circles", "asymmetric_circles"
_INVERTED = "inverted_"
_PATTERNS = [
    inverted + kind for inverted in ("", _INVERTED) for kind in (_CHESSBOARD, _CIRCLES, _ASYMMETRIC)
]
# A board on its own is the map: its first corner is the origin, x along the rows, y from row to
# row, z away from the viewer.
_BOARD_AXES = np.diag([1.0, -1.0, -1.0])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="VIDEO|BAG|FOLDER",
        help="a video (also a stream of JPEG images, .mjpeg), a rosbag2 or ROS 1 bag with raw or "
        "compressed images, or a folder of .jpg or .png files; several: see many recordings",
    )
    markers = parser.add_argument_group("what to look for")
    markers.add_argument("--map", type=Path, metavar="FILE", help="marker map")
    above = number(0.0, above=True)
    add_board_arguments(markers)
    markers.add_argument(
        "--min-side",
        type=number(0.0),
        default=DetectorConfig().min_side,
        metavar="PX",
        help="markers with a shorter side are left out (default: %(default)s)",
    )
    camera = parser.add_argument_group("the camera")
    camera.add_argument(
        "--calibration",
        type=Path,
        metavar="FILE",
        help=f"{CALIBRATION_KINDS} (default: the bag's camera_info)",
    )
    longest = settings()["readout_time"].maximum or 0.0
    camera.add_argument(
        "--readout-time",
        type=number(0.0, longest),
        metavar="S",
        help=f"seconds from the first row to the last: written to {PARAMETERS} beside the data, "
        f"for replay --params (default: as in {PARAMETERS} of the bag)",
    )
    camera.add_argument(
        "--scan-direction",
        choices=[direction.value for direction in ScanDirection],
        help=f"likewise (default: {ScanDirection.TOP_TO_BOTTOM})",
    )
    camera.add_argument(
        "--rate",
        type=above,
        metavar="HZ",
        help="images per second, instead of the presentation times of a video, or for files whose "
        "names are not times in ns",
    )
    camera.add_argument(
        "--start",
        type=number(0.0),
        metavar="S",
        help="time of the first image of a video or folder (default: "
        f"{DEFAULT_START_NS * 1e-9:g}, since ROS takes 0 for none; of names that are times, their "
        "own)",
    )
    bag = parser.add_argument_group("topics of a bag (default: the only ones of their types)")
    bag.add_argument("--image", metavar="TOPIC")
    bag.add_argument("--camera-info", metavar="TOPIC")
    parser.add_argument("--out", type=Path, required=True, help="bag directory to create")
    parser.add_argument(
        "--images", dest="with_images", action="store_true", help="copy compressed images, too"
    )
    parser.add_argument("--storage", choices=list(STORAGES), default="mcap")
    parser.add_argument(
        "--timing", action="store_true", help="say how long it took, and how much of it OpenCV did"
    )
    add_fleet_arguments(parser)


def run(args: argparse.Namespace) -> None:
    if not is_fleet(args):
        detect_one(argparse.Namespace(**vars(args), images=args.recordings[0]))
        return
    find_map(args)  # refuses wrong ones before there are workers
    many.detect(args)


def detect_one(args: argparse.Namespace) -> Recorded:
    """Detect in the images of one recording, and say what came of it."""
    marker_map = find_map(args)
    notices: Counter[str] = Counter()
    config = DetectorConfig(min_side=args.min_side)
    detector = FrameDetector(config, lambda _, text: notices.update((text,)), marker_map)
    detector.warm_up()
    clock: ImageClock | None = None
    if is_bag(args.images):
        for name in ("rate", "start"):
            if getattr(args, name) is not None:
                raise UsageError(f"--{name} is for videos and folders; a bag has its own times")
        with open_bag(args.images) as bag:
            camera = None if args.calibration is None else read_calibration(args.calibration)
            topic = find_topic(bag, IMAGE_TYPES, args.image, "--image")
            info = None
            if camera is None:
                info = find_topic(bag, (INFO_TYPE,), args.camera_info, "--camera-info")
            shots = from_bag(bag, topic, info, camera)
            recorded = _record(args, shots, bag.count([topic]), detector)
    else:
        start_ns = None if args.start is None else round(args.start * 1e9)
        clock = ImageClock(args.rate, start_ns)
        files, total = _files(args, clock)
        recorded = _record(args, files, total, detector)
    with told(args.out):
        _write_parameters(args)
    _tell(args, recorded, notices)
    _warn(args, recorded, clock)
    _tell_next(args)
    if args.timing:
        _tell_times(recorded.images, *detector.seconds)
    return recorded


def _tell_times(images: int, seconds: float, in_opencv: float) -> None:
    print(
        f"time per image: {1e3 * seconds / images:.2f} ms, of which OpenCV's search took "
        f"{1e3 * in_opencv / images:.2f} ms and all else {100 * (1 - in_opencv / seconds):.1f} %"
    )


def add_board_arguments(parser: argparse._ActionsContainer) -> None:
    """A board of its own instead of a map, for :func:`find_map`."""
    parser.add_argument(
        "--board",
        metavar="6x4",
        help="instead: a board, inner corners (or circles) along a row x rows",
    )
    parser.add_argument(
        "--pattern",
        choices=_PATTERNS,
        help=f"of the board; inverted: white on black (default: {_CHESSBOARD})",
    )
    parser.add_argument(
        "--square",
        type=number(0.0, above=True),
        metavar="M",
        help="side of its squares in metres, or distance of its rows of circles",
    )


def find_map(args: argparse.Namespace) -> MarkerMap:
    if (args.map is None) == (args.board is None):
        raise UsageError("give either --map or --board")
    if args.map is not None:
        for name in ("square", "pattern"):
            if getattr(args, name) is not None:
                raise UsageError(f"--{name} goes with --board")
        marker_map = read_marker_map(args.map)
        for fault in other_units(marker_map):
            print(f"warning: {args.map}: {fault}", file=sys.stderr)
        return marker_map
    if args.square is None:
        raise UsageError("--board needs --square")
    try:
        columns, rows = (int(word) for word in args.board.split("x"))
    except ValueError:
        raise UsageError(f"--board must be of the form 6x4, got {args.board!r}") from None
    pattern = args.pattern or _CHESSBOARD
    inverted, kind = pattern.startswith(_INVERTED), pattern.removeprefix(_INVERTED)
    try:
        if kind == _CHESSBOARD:
            board: Board = Chessboard(columns, rows, args.square, inverted=inverted)
        else:
            board = CircleGrid(columns, rows, args.square, kind == _ASYMMETRIC, inverted)
    except ValueError as error:
        raise UsageError(f"--board: {error}") from error
    # The first corner to the origin.
    pose = Pose(-_BOARD_AXES @ board.points[0], _BOARD_AXES)
    marker_map = MarkerMap(boards=(replace(board, pose=pose),))
    for fault in other_units(marker_map):
        raise UsageError(f"--square: {fault}")
    return marker_map


def _files(args: argparse.Namespace, clock: ImageClock) -> tuple[Iterator[Shot], int | None]:
    for name in ("image", "camera_info"):
        if getattr(args, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is a topic of a bag")
    if args.calibration is None:
        raise UsageError("a video or folder has no camera_info: give --calibration")
    files = image_files(args.images) if args.images.is_dir() else None
    if args.rate is None and files is not None and not have_times(files):
        raise UsageError("the names of the files are not times in ns: give --rate")
    if args.rate is None and files is None and not has_times(args.images):
        raise UsageError("this video has no presentation times: give --rate")
    camera: Camera = read_calibration(args.calibration)
    if files is None:
        return from_video(args.images, camera, clock), None
    return from_files(files, camera, clock), len(files)


def _record(
    args: argparse.Namespace,
    shots: Iterator[Shot] | Iterator[Shot | Carried],
    total: int | None,
    detector: FrameDetector,
) -> Recorded:
    with tqdm(total=total, unit="image", desc="detect", disable=None) as progress:
        return record(
            shots,
            detector,
            args.out,
            Options(
                args.storage,
                args.with_images,
                args.scan_direction or ScanDirection.TOP_TO_BOTTOM,
            ),
            done=progress.update,
            tell=lambda text: progress.write(f"note: {text}", file=sys.stderr),
        )


def _write_parameters(args: argparse.Namespace) -> None:
    """The shutter: as given, or as simulate writes it beside the images of a recording."""
    beside = args.images / PARAMETERS
    if args.readout_time is not None:
        direction = args.scan_direction or ScanDirection.TOP_TO_BOTTOM.value
        write_parameters(args.out / PARAMETERS, args.readout_time, direction)
    elif is_bag(args.images) and beside.exists():
        shutil.copy(beside, args.out / PARAMETERS)


def _tell(args: argparse.Namespace, recorded: Recorded, notices: Counter[str]) -> None:
    fit = ""
    if np.isfinite(recorded.residual):
        fit = f", within {recorded.residual:.3f} px rms of a global-shutter pose (median)"
    print(
        f"{args.out}: {recorded.with_corners} of {recorded.images} images, "
        f"{recorded.corners:.0f} corners each (median){fit}"
    )
    if recorded.with_corners < recorded.images:
        print(f"{recorded.images - recorded.with_corners} images show nothing of the map")
    for detail in recorded.refused.values():
        print(f"images that cannot be read are left out, the first one because {detail}")
    if recorded.carried:
        kept = ", ".join(f"{topic} ({count})" for topic, count in recorded.carried.items())
        print(f"kept for replay: {kept}")
    for text, count in notices.most_common(3):
        print(f"note ({count} images): {text}")


def _warn(args: argparse.Namespace, recorded: Recorded, clock: ImageClock | None) -> None:
    """What the times are, and all that speaks against what was given."""
    faults = [*recorded.faults]
    if clock is not None:
        print(clock.told())
        faults.append(clock.fault() or "")
    if args.readout_time is not None:
        faults.append(readout_fault(args.readout_time, recorded.period) or "")
    for fault in filter(None, faults):
        print(f"warning: {fault}")


def _tell_next(args: argparse.Namespace) -> None:
    out = shlex.quote(str(args.out))
    with_parameters = (args.out / PARAMETERS).exists()
    shutter = f"--params {out}/{PARAMETERS}" if with_parameters else "-p readout_time:=SECONDS"
    print(f"next: rs_localizer replay {out} {shutter} --out {shlex.quote(f'{args.out}_poses')}")
