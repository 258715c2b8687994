# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer detect``: images of markers, a board or anything -> a recording for ``replay``."""

from __future__ import annotations

import math
import sys
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from rs_localizer.cli import WORKING, replaced, with_values
from rs_localizer.cli.image_input import (
    ImageOptions,
    opened,
    shutter_values,
    tell_left_out,
    tell_next,
    tell_telemetry,
    time_faults,
    write_shutter,
)
from rs_localizer.cli.marker_map import TargetOptions, find_map
from rs_localizer.cli.options import UsageError, argument, option
from rs_localizer.cli.rig_input import cameras_of
from rs_localizer.config import DetectorConfig, FeatureConfig, FeatureKind
from rs_localizer.io.bags import BagWriter, is_bag
from rs_localizer.io.image_clock import DEFAULT_START_NS, ImageClock
from rs_localizer.settings import build, settings

if WORKING:
    import numpy as np
    from tqdm import tqdm

    from rs_localizer.io.atomic_files import atomic_directory
    from rs_localizer.io.rigs import make_mounts, read_camchain
    from rs_localizer.io.topics import TF_STATIC
    from rs_localizer.offline import detect as offline
    from rs_localizer.offline.detect import Extraction, Recorded, record, record_features
    from rs_localizer.offline.fleet import Figures
    from rs_localizer.offline.image_sources import Carried, Shot
    from rs_localizer.pipeline.images import FrameDetector
    from rs_localizer.pipeline.keypoints import FrameExtractor

    Shots = Iterable[Shot | Carried]

Seen = TypeVar("Seen")

# Options of markers and boards.
_OF_MARKERS = ("map", "board", "pattern", "square")
_LEAST_KEYPOINTS = settings(FeatureConfig)["max_keypoints"].minimum or 1.0


@dataclass(frozen=True, kw_only=True)
class Options(TargetOptions, ImageOptions):
    images: Path = argument(
        "a video (also a stream of JPEG images, .mjpeg), a rosbag2 or ROS 1 bag with raw or "
        "compressed images, or a folder of .jpg or .png files", "VIDEO|BAG|FOLDER",
    )  # fmt: skip
    features: str | None = option(
        "instead: keypoints with descriptors, to be matched with a map; sift: as COLMAP's",
        choices=[kind.value for kind in FeatureKind],
    )
    max_keypoints: int | None = option(
        "of an image, the best of all its parts (default: "
        f"{FeatureConfig().max_keypoints})", "N", limits=(_LEAST_KEYPOINTS, math.inf),
    )  # fmt: skip
    out: Path = option("bag directory to create", "DIR", required=True)
    overwrite: bool = option("replace an earlier result", default=False)
    with_images: bool = option("copy compressed images, too", default=False, flag="--images")


def run(args: Options) -> Figures | None:
    if args.features is None and args.max_keypoints is not None:
        raise UsageError("--max-keypoints goes with --features")
    if args.features is None and args.map is None and args.board is None:
        raise UsageError("give --map, --board or --features")
    if args.features is None:
        figures = detect_one(args)
        tell_next(args)
        return figures
    detect_features(args)
    tell_next(args, " --map MAP")
    return None


def detect_one(args: Options) -> Figures:
    """Detect in the images of one recording, of each camera of a rig, and say what came of it."""
    marker_map = find_map(args)
    config = DetectorConfig()

    def look(
        shots: Shots, bag: BagWriter, options: offline.Options, bar: Any
    ) -> tuple[Recorded, Counter[str]]:
        notices: Counter[str] = Counter()
        detector = FrameDetector(config, lambda _, text: notices.update([text]), marker_map)
        detector.warm_up()
        recorded = record(
            shots, detector, bag, options, done=bar.update,
            tell=lambda text: bar.write(f"note: {text}", file=sys.stderr),
        )  # fmt: skip
        return recorded, notices

    every = []
    for name, (recorded, notices), clock in _look(args, look, marker_map.settings):
        _tell(_place(args, name), recorded, notices)
        for fault in (*recorded.faults, *time_faults(args, clock, recorded.period, name)):
            print(f"warning: {fault}")
        every.append(recorded)
    tell_telemetry(args)
    return {
        "images": sum(one.images for one in every),
        "with_corners": sum(one.with_corners for one in every),
        "corners": min(one.corners for one in every),
        "residual_of_a_still_pose_px": max(one.residual for one in every),
        "warnings": "; ".join(fault for one in every for fault in one.faults),
    }


def _look(
    args: Options,
    look: Callable[[Shots, BagWriter, offline.Options, Any], Seen],
    of_map: Mapping[str, float] | None = None,
) -> list[tuple[str, Seen, ImageClock | None]]:
    """Record what ``look`` finds in the images of each camera of a rig, or of one without a name.

    Where the lenses of one video are goes into the bag.
    """
    settings, seen = build(shutter_values(args)), []
    with atomic_directory(args.out, replaced(args, "metadata.yaml")) as out:
        with BagWriter(out) as bag:
            cameras = {"": args}
            if settings.of_cameras:
                rig = cameras_of(with_values(args, recordings=[args.images]), settings)
                cameras = {name: own.args for name, own in rig.items()}
                if args.calibration is not None and not is_bag(args.images):
                    bag.write(
                        TF_STATIC, make_mounts(read_camchain(args.calibration)), DEFAULT_START_NS
                    )
            for name, own in cameras.items():
                with (
                    opened(own, args.images) as source,
                    tqdm(total=source.total, unit="image", desc="detect", disable=None) as bar,
                ):
                    shots: Shots = source.shots
                    if name not in ("", settings.cameras[0]):  # what goes along is of the first
                        shots = (shot for shot in shots if not isinstance(shot, Carried))
                    direction = settings.of_cameras.get(name, settings).scan_direction
                    options = offline.Options(args.with_images, direction, name)
                    seen.append((name, look(shots, bag, options, bar), source.clock))
        write_shutter(args, out, of_map)
    return seen


def _place(args: Options, name: str) -> str:
    return f"{args.out}, {name}" if name else str(args.out)


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


def detect_features(args: Options) -> None:
    """Find the keypoints of all images."""
    for name in _OF_MARKERS:
        if getattr(args, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for markers; give it or --features")
    kind = args.features or ""
    config = FeatureConfig(features=kind)
    if args.max_keypoints is not None:
        config = FeatureConfig(features=kind, max_keypoints=args.max_keypoints)
    extractor = FrameExtractor(config)

    def look(shots: Shots, bag: BagWriter, options: offline.Options, bar: Any) -> Extraction:
        return record_features(shots, extractor, bag, options, bar.update)

    for name, extraction, clock in _look(args, look):
        with_any = len(extraction.counts)
        print(
            f"{_place(args, name)}: {with_any} of {extraction.images} images, "
            f"{np.median(extraction.counts):.0f} keypoints ({args.features}) each (median)"
        )
        if bare := len(extraction.stamps_ns) - with_any:
            print(f"{bare} images have no keypoint")
        tell_left_out(extraction.refused, extraction.carried)
        for fault in time_faults(args, clock, extraction.period, name):
            print(f"warning: {fault}")
    tell_telemetry(args)
