# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer detect``: images of markers, a board or anything -> a recording for ``replay``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rs_localizer.cli import earlier_result, typed
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.recording_input import (
    ImageOptions,
    TargetOptions,
    cameras_of,
    find_map,
    opened,
    print_images,
    shutter_values,
)
from rs_localizer.config import DetectorConfig, FeatureConfig, FeatureKind
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.recording import PARAMETERS
from rs_localizer.offline import detect as offline
from rs_localizer.offline.detect import Extraction, record_features, record_markers
from rs_localizer.offline.image_sources import Carried, Shot
from rs_localizer.offline.tasks import Figures
from rs_localizer.pipeline.keypoints import FrameExtractor
from rs_localizer.pipeline.marker_detector import FrameDetector
from rs_localizer.settings import build, settings, write_parameters

Shots = Iterable[Shot | Carried]

_LEAST_KEYPOINTS = settings(FeatureConfig)["max_keypoints"].minimum or 1.0


@dataclass(frozen=True, kw_only=True)
class Options(TargetOptions, ImageOptions, ResultOptions):
    recording: Path = argument(
        "a video (also a stream of JPEG images, .mjpeg), a rosbag2 or ROS 1 bag with raw or "
        "compressed images, or a folder of .jpg or .png files", "VIDEO|BAG|FOLDER",
    )  # fmt: skip
    features: str | None = option(
        "instead: keypoints with descriptors, to be matched with a map; sift: as COLMAP's",
        choices=[kind.value for kind in FeatureKind],
    )
    max_keypoints: int | None = option(
        "of an image, the best of all its parts (default: "
        f"{FeatureConfig().max_keypoints})", "N", least=_LEAST_KEYPOINTS,
    )  # fmt: skip
    out: Path = option("bag directory to create", "DIR", required=True)
    with_images: bool = option("copy compressed images, too", default=False, flag="--images")


def run(args: Options) -> Figures:
    figures = detect(args)
    if not {"readout_time", "cameras"} & set(shutter_values(args)):
        print(
            "the readout time is not known: poses come without twists; calibrate measures it, and "
            "-p readout_time:=SECONDS gives it to the next command"
        )
    parameters = args.out / PARAMETERS
    params = ["--params", str(parameters)] if parameters.exists() else []
    words = ["replay", str(args.out), *params, "--out", f"{args.out}_poses"]
    print(f"next: {typed(*words)}{' --map MAP' if args.features else ''}")
    return figures


def detect(args: Options) -> Figures:
    """Detect in the images of one recording, of each camera of a rig, and say what came of it."""
    of_map, detect_images = _of_markers(args) if args.features is None else _of_features(args)
    settings, warnings = build(shutter_values(args)), list[str]()
    every = list[tuple[int, int, float, float]]()
    kind = "keypoints" if args.features else "corners"
    with atomic_directory(args.out, earlier_result(args, "metadata.yaml")) as out:
        with BagWriter(out) as bag:
            cameras = {"": args}
            if settings.of_cameras:
                rig = cameras_of(args, [args.recording], settings)
                cameras = {name: own for name, (own, _) in rig.items()}
            for name, own in cameras.items():
                of = settings.of_cameras.get(name, settings)
                with opened(own) as source:
                    shots: Shots = source.shots
                    if name not in ("", settings.cameras[0]):  # what goes along is of the first
                        shots = (shot for shot in shots if not isinstance(shot, Carried))
                    options = offline.DetectionOptions(args.with_images, of.scan_direction, name)
                    found = detect_images(shots, bag, options)
                count, median = len(found.counts), float(np.median(found.counts))
                every.append((found.images, count, median, found.residual))
                said = f"{count} of {found.images} images, {median:.0f} {kind}"
                said += f" ({args.features}) each (median)" if args.features else " each (median)"
                if np.isfinite(found.residual):
                    said += (
                        f", within {found.residual:.3f} px rms of a global-shutter pose (median)"
                    )
                print(f"{f'{args.out}, {name}' if name else args.out}: {said}")
                print("".join(f"note {note}\n" for note in found.notes), end="")
                if kept := [f"{topic} ({count})" for topic, count in found.carried.items()]:
                    print(f"kept for replay: {', '.join(kept)}")
                for fault in found.faults:
                    print(f"warning: {fault}")
                print_images(found.refused, source.clock, of.readout_time, found.period)
                warnings += found.faults
        if values := {**of_map, **shutter_values(args)}:
            write_parameters(out / PARAMETERS, values)
    images, counts, medians, residuals = zip(*every, strict=True)
    figures: Figures = {"images": sum(images), f"with_{kind}": sum(counts), kind: min(medians)}
    if not args.features:
        figures |= {"residual_of_a_still_pose_px": max(residuals)}
    return figures | {"warnings": "; ".join(warnings)}


Detection = Callable[[Shots, BagWriter, offline.DetectionOptions], Extraction]


def _of_markers(args: Options) -> tuple[Mapping[str, float], Detection]:
    if args.max_keypoints is not None:
        raise UsageError("--max-keypoints goes with --features")
    if args.map is None and args.board is None:
        raise UsageError("give --map, --board or --features")
    marker_map, config = find_map(args), DetectorConfig()

    def detect_images(
        shots: Shots, bag: BagWriter, options: offline.DetectionOptions
    ) -> Extraction:
        notices: Counter[str] = Counter()
        detector = FrameDetector(config, lambda _, text: notices.update([text]), marker_map)
        found = record_markers(shots, detector, bag, options)
        texts = notices.most_common(3)
        found.notes = tuple(f"({number} images): {text}" for text, number in texts)
        return found

    return marker_map.settings, detect_images


def _of_features(args: Options) -> tuple[Mapping[str, float], Detection]:
    for name in ("map", "board", "square"):
        if getattr(args, name) is not None:
            raise UsageError(f"--{name} is for markers; give it or --features")
    most = args.max_keypoints or FeatureConfig().max_keypoints
    extractor = FrameExtractor(FeatureConfig(features=args.features or "", max_keypoints=most))
    return {}, lambda shots, bag, options: record_features(shots, extractor, bag, options)
