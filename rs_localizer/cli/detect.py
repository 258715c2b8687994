# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer detect``: images of markers, a board or anything -> a recording for ``replay``."""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from collections.abc import Iterator
from functools import partial
from pathlib import Path

from rs_localizer.cli import WORKING, UsageError, add_overwrite, integer, number, replaced
from rs_localizer.cli.batch import Plan, add_batch_arguments, inputs, is_batch, run_batch
from rs_localizer.cli.image_input import (
    Source,
    add_source_arguments,
    opened,
    shutter_values,
    tell_left_out,
    tell_next,
    tell_telemetry,
    time_faults,
    write_shutter,
)
from rs_localizer.cli.marker_map import add_board_arguments, find_map
from rs_localizer.cli.rig_input import cameras_of
from rs_localizer.config import DetectorConfig, FeatureConfig, FeatureKind
from rs_localizer.io.bags import STORAGES, BagWriter, is_bag
from rs_localizer.io.image_clock import DEFAULT_START_NS
from rs_localizer.settings import build, settings

if WORKING:
    import numpy as np
    from tqdm import tqdm

    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.rigs import make_mounts, read_camchain
    from rs_localizer.io.topics import TF_STATIC
    from rs_localizer.offline.detect import Extraction, Options, Recorded, record, record_features
    from rs_localizer.offline.fleet.task import Figures, Kind
    from rs_localizer.offline.image_sources import Carried, Shot
    from rs_localizer.pipeline.images import FrameDetector
    from rs_localizer.pipeline.keypoints import FrameExtractor

# Options of markers and boards.
_OF_MARKERS = ("map", "board", "pattern", "square", "min_side")


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
    _add_feature_arguments(wanted)
    add_source_arguments(parser)
    parser.add_argument("--out", type=Path, required=True, help="bag directory to create")
    add_overwrite(parser)
    parser.add_argument(
        "--images", dest="with_images", action="store_true", help="copy compressed images, too"
    )
    parser.add_argument("--storage", choices=list(STORAGES), default="mcap")
    parser.add_argument(
        "--timing", action="store_true", help="say how long it took, and how much of it OpenCV did"
    )
    add_batch_arguments(parser)


def run(args: argparse.Namespace) -> Figures | None:
    if args.features is None and args.max_keypoints is not None:
        raise UsageError("--max-keypoints goes with --features")
    if args.features is None and args.map is None and args.board is None:
        raise UsageError("give --map, --board or --features")
    if not is_batch(args):
        alone = argparse.Namespace(**vars(args), images=args.recordings[0])
        if args.features is None:
            recorded = detect_one(alone)
            tell_next(alone)
            return _figures(*recorded)
        detect_features(alone)
        tell_next(alone, " --map MAP")
        return None
    if args.features is not None:
        raise UsageError("--features takes one recording")
    find_map(args)  # refuses wrong ones before there are workers
    _detect_batch(args)
    return None


def detect_one(args: argparse.Namespace) -> list[Recorded]:
    """Detect in the images of one recording, of each camera of a rig, and say what came of it."""
    marker_map = find_map(args)
    config = DetectorConfig() if args.min_side is None else DetectorConfig(min_side=args.min_side)
    recordings = []
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as out:
        with BagWriter(out, args.storage) as bag:
            for name, own in _cameras(args, bag).items():
                notices: Counter[str] = Counter()
                detector = FrameDetector(config, partial(_count, notices), marker_map)
                detector.warm_up()
                with opened(own, args.images, args.start) as source:
                    recorded = _record(own, name, source, detector, bag)
                recordings.append((name, recorded, notices, detector.seconds, source.clock))
        write_shutter(args, out, marker_map.settings)
    for name, recorded, notices, seconds, clock in recordings:
        _tell(f"{args.out}{f', {name}' if name else ''}", recorded, notices)
        for fault in (*recorded.faults, *time_faults(args, clock, recorded.period, name)):
            print(f"warning: {fault}")
        if args.timing:
            _tell_times(recorded.images, *seconds)
    tell_telemetry(args)
    return [recorded for _, recorded, *_ in recordings]


def _cameras(args: argparse.Namespace, bag: BagWriter) -> dict[str, argparse.Namespace]:
    """The arguments of each camera of a rig by its name, or of one that is alone, by "".

    Where the lenses of one video are goes into the bag.
    """
    settings = build(shutter_values(args))
    if not settings.is_rig:
        return {"": args}
    rig = cameras_of(argparse.Namespace(**vars(args) | {"recordings": [args.images]}), settings)
    if args.calibration is not None and not is_bag(args.images):
        start = DEFAULT_START_NS if args.start is None else round(1e9 * args.start)
        bag.write(TF_STATIC, make_mounts(read_camchain(args.calibration)), start)
    return {name: own.args for name, own in rig.items()}


def _count(notices: Counter[str], _: str, text: str) -> None:
    notices[text] += 1


def _tell_times(images: int, seconds: float, in_opencv: float) -> None:
    print(
        f"time per image: {1e3 * seconds / images:.2f} ms, of which OpenCV's search took "
        f"{1e3 * in_opencv / images:.2f} ms and all else {100 * (1 - in_opencv / seconds):.1f} %"
    )


def _record(
    args: argparse.Namespace, name: str, source: Source, detector: FrameDetector, bag: BagWriter
) -> Recorded:
    with tqdm(total=source.total, unit="image", desc="detect", disable=None) as progress:
        return record(
            _shots(args, name, source),
            detector,
            bag,
            _options(args, name),
            done=progress.update,
            tell=lambda text: progress.write(f"note: {text}", file=sys.stderr),
        )


def _shots(args: argparse.Namespace, name: str, source: Source) -> Iterator[Shot | Carried]:
    """The images of a camera; what goes along comes with the first of a rig only."""
    if name in ("", build(shutter_values(args)).cameras[0]):
        return iter(source.shots)
    return (shot for shot in source.shots if not isinstance(shot, Carried))


def _tell(what: str, recorded: Recorded, notices: Counter[str]) -> None:
    fit = ""
    if np.isfinite(recorded.residual):
        fit = f", within {recorded.residual:.3f} px rms of a global-shutter pose (median)"
    print(
        f"{what}: {recorded.with_corners} of {recorded.images} images, "
        f"{recorded.corners:.0f} corners each (median){fit}"
    )
    if recorded.with_corners < recorded.images:
        print(f"{recorded.images - recorded.with_corners} images show no part of the map")
    tell_left_out(recorded.refused, recorded.carried)
    for text, count in notices.most_common(3):
        print(f"note ({count} images): {text}")


def _options(args: argparse.Namespace, name: str = "") -> Options:
    settings = build(shutter_values(args))
    own = settings.of_cameras.get(name, settings)
    return Options(args.with_images, own.scan_direction, name)


def _add_feature_arguments(parser: argparse._ActionsContainer) -> None:
    """For :func:`detect_features`."""
    parser.add_argument(
        "--features",
        choices=[kind.value for kind in FeatureKind],
        help="instead: keypoints with descriptors, to be matched with a map; sift: as COLMAP's",
    )
    setting = settings(FeatureConfig)["max_keypoints"]
    parser.add_argument(
        "--max-keypoints",
        type=integer(int(setting.minimum or 1)),
        metavar="N",
        help=f"of an image, the best of all its parts (default: {setting.default})",
    )


def detect_features(args: argparse.Namespace) -> None:
    """Find the keypoints of all images."""
    for name in _OF_MARKERS:
        if getattr(args, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for markers; give it or --features")
    config = FeatureConfig(features=args.features)
    if args.max_keypoints is not None:
        config = FeatureConfig(features=args.features, max_keypoints=args.max_keypoints)
    extractor = FrameExtractor(config)
    of_cameras = []
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as out:
        with BagWriter(out, args.storage) as bag:
            for name, own in _cameras(args, bag).items():
                with (
                    opened(own, args.images, args.start) as source,
                    tqdm(total=source.total, unit="image", desc="detect", disable=None) as progress,
                ):
                    shots, options = _shots(args, name, source), _options(args, name)
                    extraction = record_features(shots, extractor, bag, options, progress.update)
                of_cameras.append((name, extraction, source.clock))
        write_shutter(args, out)
    for name, extraction, clock in of_cameras:
        _tell_features(args, f"{args.out}{f', {name}' if name else ''}", extraction)
        for fault in time_faults(args, clock, extraction.period, name):
            print(f"warning: {fault}")
    tell_telemetry(args)
    if args.timing:
        images = sum(len(extraction.stamps_ns) for _, extraction, _ in of_cameras)
        milliseconds = 1e3 * extractor.seconds / images
        print(f"time per image: {milliseconds:.1f} ms, {1e3 / milliseconds:.0f} images/s")


def _tell_features(args: argparse.Namespace, what: str, extraction: Extraction) -> None:
    with_any = len(extraction.counts)
    print(
        f"{what}: {with_any} of {extraction.images} images, "
        f"{np.median(extraction.counts):.0f} keypoints ({args.features}) each (median)"
    )
    if bare := len(extraction.stamps_ns) - with_any:
        print(f"{bare} images have no keypoint")
    tell_left_out(extraction.refused, extraction.carried)


def _detect_batch(args: argparse.Namespace) -> None:
    """``detect`` in many recordings."""
    if args.timing:
        raise UsageError("--timing is for one recording: beside others it means little")
    files = inputs(args.map, args.calibration, args.params)
    kind = Kind("detect", _detect_of_many, "detect", _detect_warm)
    run_batch(args, Plan(kind, lambda _: files, args.overwrite))


def _detect_warm(_: argparse.Namespace) -> None:
    """Compile what the search needs."""
    from rs_localizer.markers.detection import warm_up

    warm_up()


def _detect_of_many(args: argparse.Namespace, recording: Path, out: Path) -> Figures:
    """One of them: its result in ``out``, and figures for the summary."""
    return _figures(
        *detect_one(argparse.Namespace(**vars(args), images=recording, out=out, overwrite=False))
    )


def _figures(*recorded: Recorded) -> Figures:
    return {
        "images": sum(one.images for one in recorded),
        "with corners": sum(one.with_corners for one in recorded),
        "corners": min(one.corners for one in recorded),
        "residual of a still pose (px)": max(one.residual for one in recorded),
        "warnings": "; ".join(fault for one in recorded for fault in one.faults),
    }
