"""``rs_localizer detect``: images of markers or a board -> a recording for ``replay``."""

from __future__ import annotations

import argparse
import shlex
import shutil
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer.arguments import number
from rs_localizer.cli import UsageError
from rs_localizer.config import DetectorConfig
from rs_localizer.core.camera import Camera, ScanDirection
from rs_localizer.detect import Recorded, record
from rs_localizer.image_sources import (
    IMAGE_TYPES,
    INFO_TYPE,
    Shot,
    find_topic,
    from_bag,
    from_files,
    from_video,
    have_times,
    image_files,
)
from rs_localizer.io.bags import STORAGES, open_bag
from rs_localizer.io.calibration import read_calibration
from rs_localizer.lab.recording import PARAMETERS, write_parameters
from rs_localizer.marker_frames import FrameDetector
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.poses import Pose
from rs_localizer.markers.prints import Chessboard
from rs_localizer.settings import settings

_BAG_SUFFIXES = (".mcap", ".db3", ".bag")
# A board on its own is the map: its first corner is the origin, x along the rows, y from row to
# row, z away from the viewer.
_BOARD_AXES = np.diag([1.0, -1.0, -1.0])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "images",
        type=Path,
        metavar="VIDEO|BAG|FOLDER",
        help="a video (also a stream of JPEG images, .mjpeg), a rosbag2 or ROS 1 bag with raw or "
        "compressed images, or a folder of .jpg or .png files",
    )
    markers = parser.add_argument_group("what to look for")
    markers.add_argument("--map", type=Path, metavar="FILE", help="marker map")
    markers.add_argument(
        "--board", metavar="6x4", help="instead: a chessboard, inner corners along a row x rows"
    )
    above = number(0.0, above=True)
    markers.add_argument("--square", type=above, metavar="M", help="side of its squares")
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
        help="YAML of ROS' camera_calibration or of BoofCV (default: the bag's camera_info)",
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
        help="images per second of a video, or of files whose names are no times in ns",
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


def run(args: argparse.Namespace) -> None:
    marker_map = find_map(args)
    notices: Counter[str] = Counter()
    config = DetectorConfig(min_side=args.min_side)
    detector = FrameDetector(config, lambda _, text: notices.update((text,)), marker_map)
    detector.warm_up()
    if is_bag(args.images):
        with open_bag(args.images) as bag:
            camera = None if args.calibration is None else read_calibration(args.calibration)
            topic = find_topic(bag, IMAGE_TYPES, args.image, "--image")
            info = None
            if camera is None:
                info = find_topic(bag, (INFO_TYPE,), args.camera_info, "--camera-info")
            shots = from_bag(bag, topic, info, camera)
            recorded = _record(args, shots, bag.count([topic]), detector)
        _copy_parameters(args)
    else:
        shots, total = _files(args)
        recorded = _record(args, shots, total, detector)
    if args.readout_time is not None:
        direction = args.scan_direction or ScanDirection.TOP_TO_BOTTOM.value
        write_parameters(args.out, args.readout_time, direction)
    _tell(args, recorded, notices)
    if args.timing:
        _tell_times(recorded.images, *detector.seconds)


def _tell_times(images: int, seconds: float, in_opencv: float) -> None:
    print(
        f"time per image: {1e3 * seconds / images:.2f} ms, of which OpenCV's search took "
        f"{1e3 * in_opencv / images:.2f} ms and all else {100 * (1 - in_opencv / seconds):.1f} %"
    )


def is_bag(path: Path) -> bool:
    if path.is_dir():
        holds = {file.suffix for file in path.iterdir()}
        return (path / "metadata.yaml").exists() or bool(holds & set(_BAG_SUFFIXES))
    return path.suffix in _BAG_SUFFIXES


def find_map(args: argparse.Namespace) -> MarkerMap:
    if (args.map is None) == (args.board is None):
        raise UsageError("give either --map or --board")
    if args.map is not None:
        if args.square is not None:
            raise UsageError("--square goes with --board")
        return read_marker_map(args.map)
    if args.square is None:
        raise UsageError("--board needs --square")
    try:
        columns, rows = (int(word) for word in args.board.split("x"))
    except ValueError:
        raise UsageError(f"--board must be of the form 6x4, got {args.board!r}") from None
    middle = 0.5 * args.square * np.array([columns - 1, rows - 1, 0])
    try:
        board = Chessboard(columns, rows, args.square, Pose(middle, _BOARD_AXES))
    except ValueError as error:
        raise UsageError(f"--board: {error}") from error
    return MarkerMap(boards=(board,))


def _files(args: argparse.Namespace) -> tuple[Iterator[Shot], int | None]:
    for name in ("image", "camera_info"):
        if getattr(args, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is a topic of a bag")
    if args.calibration is None:
        raise UsageError("a video or folder has no camera_info: give --calibration")
    files = image_files(args.images) if args.images.is_dir() else None
    rate = args.rate
    if files is not None and rate is None and not have_times(files):
        raise UsageError("the names of the files are no times in ns: give --rate")
    if files is None and rate is None:
        raise UsageError("a video has no time stamps: give --rate")
    camera: Camera = read_calibration(args.calibration)
    if files is None:
        return from_video(args.images, camera, rate), None
    return from_files(files, camera, rate), len(files)


def _record(
    args: argparse.Namespace, shots: Iterator[Shot], total: int | None, detector: FrameDetector
) -> Recorded:
    with tqdm(total=total, unit="image", desc="detect", disable=None) as progress:
        return record(
            shots,
            detector,
            args.out,
            storage=args.storage,
            with_images=args.with_images,
            done=progress.update,
        )


def _copy_parameters(args: argparse.Namespace) -> None:
    """The shutter of a recording, as simulate writes it beside its images."""
    beside = args.images / PARAMETERS
    if args.readout_time is None and args.images.is_dir() and beside.exists():
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
    for text, count in notices.most_common(3):
        print(f"note ({count} images): {text}")
    out = shlex.quote(str(args.out))
    with_parameters = (args.out / PARAMETERS).exists()
    shutter = f"--params {out}/{PARAMETERS}" if with_parameters else "-p readout_time:=SECONDS"
    print(f"next: rs_localizer replay {out} {shutter} --out {shlex.quote(f'{args.out}_poses')}")
