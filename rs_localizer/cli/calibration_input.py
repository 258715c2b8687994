# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Input of ``rs_localizer calibrate``: correspondences of a camera, or its images of a map."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from dataclasses import dataclass, replace

from rs_localizer.cli.options import UsageError, option
from rs_localizer.cli.recording_input import (
    ImageOptions,
    TargetOptions,
    check_there,
    each_image,
    find_map,
    recorded,
    remapped,
)
from rs_localizer.config import DetectorConfig, NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagReader, is_bag, open_bag
from rs_localizer.io.imu import ImuRecording
from rs_localizer.io.maps.files import read_map_file
from rs_localizer.io.topics import IMAGE, IMU
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.offline.recordings import read_imu_recording
from rs_localizer.offline.replay import has_frames
from rs_localizer.pipeline.marker_detector import FrameDetector
from rs_localizer.tools.adjust.observe import ImagePoints, in_order
from rs_localizer.tools.first_lens import first_lens


@dataclass(frozen=True, kw_only=True)
class InputOptions(TargetOptions, ImageOptions):
    intrinsics: bool = option("find the lens as well", default=False)
    imu: bool = option(
        "find how the IMU of a bag goes with the camera: offset of its stamps, rotation, bias",
        default=False,
    )  # fmt: skip


@dataclass(frozen=True, slots=True, eq=False)
class CalibrationInput:
    """Images with correspondences, and their camera."""

    images: list[ImagePoints]
    camera: Camera
    find_lens: bool  # it is to be found, or a first guess of this command
    imu: ImuRecording | None = None
    map: MarkerMap | None = None  # of images
    own_stamps: bool = True


def read_input(args: InputOptions, config: NodeConfig) -> CalibrationInput:
    path, topics = args.recording, remapped(args)
    check_there([path])
    of_bag, imu = is_bag(path), None
    if args.imu and not of_bag:
        raise UsageError("--imu is for bags, which have an IMU beside the images")
    with open_bag(path) if of_bag else nullcontext() as bag:
        if bag is not None and args.imu:
            imu = read_imu_recording(bag, topics.get(IMU))
        if bag is not None and IMAGE not in topics and has_frames(bag):
            if args.rate is not None:
                raise UsageError("--rate is for images; a bag has its own times")
            return replace(_correspondences(args, bag, config), imu=imu)
    own_stamps = of_bag or (path.is_dir() and args.rate is None)
    return replace(_detected(args), own_stamps=own_stamps, imu=imu)


def _correspondences(args: InputOptions, bag: BagReader, config: NodeConfig) -> CalibrationInput:
    if args.board is not None:
        raise UsageError("--board is for images; the recording has correspondences")
    landmarks = None if args.map is None else read_map_file(args.map, config.map_frame)
    camera, clouds = recorded(args, bag, config, landmarks)
    images = [ImagePoints(cloud.stamp_ns, cloud.points, cloud.pixels) for cloud in clouds]
    return CalibrationInput(images, camera, args.intrinsics)


def _detected(args: InputOptions) -> CalibrationInput:
    marker_map = find_map(args)
    detector = FrameDetector(DetectorConfig(), lambda name, text: None, marker_map)
    images = list[ImagePoints]()
    camera: Camera | None = None
    size = (0, 0)
    for image, own in each_image(args, NodeConfig().scan_direction, calibrated=False):
        camera, size = camera or own, image.pixels.shape[::-1]
        found = detector.detect(image).detections
        images.append(ImagePoints(image.stamp_ns, found.points, found.pixels))
    print(f"{sum(len(it.points) > 0 for it in images)} of {len(images)} images show the map")
    if detector.mistake:
        print(f"warning: {detector.mistake}", file=sys.stderr)
    find_lens = args.intrinsics or camera is None
    camera = camera or first_lens(size, in_order(images))
    return CalibrationInput(images, camera, find_lens, map=marker_map)
