"""``rs_localizer detect``: images of markers, a board or anything -> a recording for ``replay``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import UsageError, detect_features, many
from rs_localizer.cli.fleet import add_fleet_arguments, is_fleet
from rs_localizer.cli.image_source import (
    add_source_arguments,
    tell_left_out,
    tell_next,
    time_faults,
    write_shutter,
)
from rs_localizer.cli.marker_map import add_board_arguments, find_map
from rs_localizer.cli.shots import Source, opened
from rs_localizer.config import DetectorConfig
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import STORAGES
from rs_localizer.offline.detect import Options, Recorded, record
from rs_localizer.pipeline.images import FrameDetector
from rs_localizer.process.arguments import number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "recordings",
        type=Path,
        nargs="+",
        metavar="VIDEO|BAG|FOLDER",
        help="a video (also a stream of JPEG images, .mjpeg), a rosbag2 or ROS 1 bag with raw or "
        "compressed images, or a folder of .jpg or .png files; several: see many recordings",
    )
    wanted = parser.add_argument_group("what to look for")
    wanted.add_argument("--map", type=Path, metavar="FILE", help="marker map")
    add_board_arguments(wanted)
    wanted.add_argument(
        "--min-side",
        type=number(0.0),
        metavar="PX",
        help=f"markers with a shorter side are left out (default: {DetectorConfig().min_side:g})",
    )
    detect_features.add_feature_arguments(wanted)
    add_source_arguments(parser)
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
    if args.features is None and args.max_keypoints is not None:
        raise UsageError("--max-keypoints goes with --features")
    if args.features is None and args.map is None and args.board is None:
        raise UsageError("give --map, --board or --features")
    if not is_fleet(args):
        alone = argparse.Namespace(**vars(args), images=args.recordings[0])
        if args.features is None:
            detect_one(alone)
        else:
            detect_features.run(alone)
        return
    if args.features is not None:
        raise UsageError("--features takes one recording")
    find_map(args)  # refuses wrong ones before there are workers
    many.detect(args)


def detect_one(args: argparse.Namespace) -> Recorded:
    """Detect in the images of one recording, and say what came of it."""
    marker_map = find_map(args)
    notices: Counter[str] = Counter()
    config = DetectorConfig() if args.min_side is None else DetectorConfig(min_side=args.min_side)
    detector = FrameDetector(config, lambda _, text: notices.update((text,)), marker_map)
    detector.warm_up()
    with opened(args, args.images, args.start) as source, atomic_directory(args.out) as out:
        recorded = _record(args, source, detector, out)
        write_shutter(args, out)
    _tell(args, recorded, notices)
    for fault in (*recorded.faults, *time_faults(args, source.clock, recorded.period)):
        print(f"warning: {fault}")
    tell_next(args)
    if args.timing:
        _tell_times(recorded.images, *detector.seconds)
    return recorded


def _tell_times(images: int, seconds: float, in_opencv: float) -> None:
    print(
        f"time per image: {1e3 * seconds / images:.2f} ms, of which OpenCV's search took "
        f"{1e3 * in_opencv / images:.2f} ms and all else {100 * (1 - in_opencv / seconds):.1f} %"
    )


def _record(
    args: argparse.Namespace, source: Source, detector: FrameDetector, out: Path
) -> Recorded:
    with tqdm(total=source.total, unit="image", desc="detect", disable=None) as progress:
        return record(
            source.shots,
            detector,
            out,
            Options(
                args.storage,
                args.with_images,
                args.scan_direction or ScanDirection.TOP_TO_BOTTOM,
            ),
            done=progress.update,
            tell=lambda text: progress.write(f"note: {text}", file=sys.stderr),
        )


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
    tell_left_out(recorded.refused, recorded.carried)
    for text, count in notices.most_common(3):
        print(f"note ({count} images): {text}")
