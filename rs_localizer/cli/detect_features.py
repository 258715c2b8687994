"""``rs_localizer detect --features``: images -> a recording of keypoints for ``replay``."""

from __future__ import annotations

import argparse

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import UsageError
from rs_localizer.cli.image_source import tell_left_out, tell_next, time_faults, write_shutter
from rs_localizer.cli.shots import opened
from rs_localizer.config import FeatureConfig, FeatureKind
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.offline.detect import Options
from rs_localizer.offline.detect_features import Extraction, record_features
from rs_localizer.pipeline.features import FrameExtractor
from rs_localizer.process.arguments import integer
from rs_localizer.settings import settings

# Options of markers and boards.
_OF_MARKERS = ("map", "board", "pattern", "square", "min_side")


def add_feature_arguments(parser: argparse._ActionsContainer) -> None:
    """For :func:`run`."""
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


def run(args: argparse.Namespace) -> None:
    """Find the keypoints of all images."""
    for name in _OF_MARKERS:
        if getattr(args, name) is not None:
            raise UsageError(f"--{name.replace('_', '-')} is for markers; give it or --features")
    config = FeatureConfig(features=args.features)
    if args.max_keypoints is not None:
        config = FeatureConfig(features=args.features, max_keypoints=args.max_keypoints)
    extractor = FrameExtractor(config)
    options = Options(
        args.storage, args.with_images, args.scan_direction or ScanDirection.TOP_TO_BOTTOM
    )
    with (
        opened(args, args.images, args.start) as source,
        atomic_directory(args.out) as out,
        tqdm(total=source.total, unit="image", desc="detect", disable=None) as progress,
    ):
        extraction = record_features(source.shots, extractor, out, options, progress.update)
        write_shutter(args, out)
    _tell(args, extraction)
    for fault in time_faults(args, source.clock, extraction.period):
        print(f"warning: {fault}")
    tell_next(args, " --map MAP")
    if args.timing:
        milliseconds = 1e3 * extractor.seconds / len(extraction.stamps_ns)
        print(f"time per image: {milliseconds:.1f} ms, {1e3 / milliseconds:.0f} images/s")


def _tell(args: argparse.Namespace, extraction: Extraction) -> None:
    with_any = len(extraction.counts)
    print(
        f"{args.out}: {with_any} of {extraction.images} images, "
        f"{np.median(extraction.counts):.0f} keypoints ({args.features}) each (median)"
    )
    if bare := len(extraction.stamps_ns) - with_any:
        print(f"{bare} images have no keypoint")
    tell_left_out(extraction.refused, extraction.carried)
