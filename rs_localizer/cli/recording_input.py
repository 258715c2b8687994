# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Inputs of commands: settings, images or a bag, their cameras, and the targets in them."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from rs_localizer.cli import read_counts
from rs_localizer.cli.options import SettingOptions, TopicOptions, UsageError, option
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io.bags import BagReader, is_bag, open_bag
from rs_localizer.io.camera_files import CALIBRATION_KINDS, read_calibration
from rs_localizer.io.clouds import Correspondences
from rs_localizer.io.image_clock import ImageClock, readout_fault
from rs_localizer.io.images import Image
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import PARAMETERS
from rs_localizer.io.topics import CAMERA_INFO, IMAGE, IMU
from rs_localizer.io.video import has_times
from rs_localizer.markers.map_files import read_marker_map
from rs_localizer.markers.maps import MarkerMap
from rs_localizer.markers.prints import Chessboard, Pose
from rs_localizer.offline.detect import ImageTally, usable
from rs_localizer.offline.image_sources import (
    Carried,
    Shot,
    from_bag,
    from_files,
    from_video,
    image_files,
    name_times,
)
from rs_localizer.offline.recordings import read_recording
from rs_localizer.offline.replay import camera_topics, find_topics
from rs_localizer.pipeline.inputs import CAMERA_INFO_TYPE, IMAGE_TYPES, INPUTS
from rs_localizer.settings import build, camera_values, load_params_file, parse_assignment


@dataclass(frozen=True, kw_only=True)
class LensOptions(SettingOptions, TopicOptions):
    """the camera."""

    calibration: Path | None = option(
        f"as calibrate writes it, lens and shutter; or {CALIBRATION_KINDS} (default: the bag's "
        "camera_info)", "FILE", flag="--camera --calibration",
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class ImageOptions(LensOptions):
    """images without times of their own."""

    rate: float | None = option(
        "images per second, instead of the presentation times of a video, or for files whose names "
        "are not times in ns", "HZ", above=0.0,
    )  # fmt: skip


def given_values(args: Any) -> dict[str, Any]:
    """Return the values of a camera's file, a params file and ``-p``, each over those before.

    Args:
        args: with ``params`` and ``assignments``, and ``calibration`` where there is a lens.

    Raises:
        UsageError: for an unknown setting, or a wrong value, with its source.
    """
    lens, values = getattr(args, "calibration", None), dict[str, Any]()
    sources: dict[str, Callable[[], Mapping[str, Any]]] = {
        "--camera": lambda: {} if lens is None else camera_values(lens),
        f"--params {args.params}": lambda: (args.params and load_params_file(args.params)) or {},
        "-p": lambda: dict(map(parse_assignment, args.assignments)),
    }
    for where, source in sources.items():
        try:
            values |= source()
            build(values)
        except ValueError as error:
            raise UsageError(f"{where}: {error}") from error
    return values


def given_settings(args: Any) -> NodeConfig:
    """Return the settings of :func:`given_values`."""
    return build(given_values(args))


def remapped(options: Any, known: Sequence[str] = (*INPUTS, IMAGE)) -> dict[str, str]:
    """Return the topics that ``-r`` gives, by input; images are one.

    Raises:
        UsageError: for an unknown input.
    """
    topics = dict[str, str]()
    for text in options.remaps:
        name, given, topic = text.partition(":=")
        if not given or not topic or name not in known:
            raise UsageError(f"-r: expected NAME:=TOPIC of {', '.join(known)}; got {text!r}")
        topics[name] = topic if topic.startswith("/") else f"/{topic}"
    return topics


def given_topics(options: Any) -> dict[str, str | None]:
    """Return the topics of the localizer's inputs."""
    return {name: topic for name, topic in remapped(options).items() if name in INPUTS}


def given_lens(options: LensOptions) -> Camera | None:
    """Return the camera of ``--camera``, if there is one."""
    return None if options.calibration is None else read_calibration(options.calibration)


def shutter_values(args: ImageOptions) -> dict[str, Any]:
    """Return the settings that were given, or that a bag has, by dotted name."""
    beside, calibration = args.recording / PARAMETERS, args.calibration
    given = args.params is not None or (calibration is not None and camera_values(calibration))
    if not given and is_bag(args.recording) and beside.exists():
        return given_values(replace(args, params=beside))
    values = given_values(args)
    if calibration is not None and not {"readout_time", "cameras"} & set(values):
        known = read_calibration(calibration).readout_time  # of Gyroflow's profiles
        values |= {"readout_time": known} if known else {}
    return values


def print_images(
    refused: Mapping[str, str], clock: ImageClock | None, readout_time: float = 0.0,
    period: float = 0.0,
) -> None:  # fmt: skip
    """Print why images could not be used, where the times of the others come from, and faults.

    Args:
        refused: details, by their reasons.
        clock: of images without times of their own.
        readout_time: s, as it was given.
        period: s from one image to the next.
    """
    for detail in refused.values():
        print(f"images that cannot be used are left out, the first one because {detail}")
    faults = [readout_fault(readout_time, period)]
    if clock is not None:
        print(clock.description())
        faults = [clock.fault(), clock.slow_motion(), *faults]
    for fault in faults:
        if fault:
            print(f"warning: {fault}")


@dataclass(frozen=True, slots=True)
class Source:
    """Images, as far as they are open."""

    shots: Iterator[Shot | Carried]  # with a bar
    clock: ImageClock | None  # of images without times of their own


@contextlib.contextmanager
def opened(args: ImageOptions, calibrated: bool = True) -> Iterator[Source]:
    """Open the images of a recording with the lens of ``--camera`` or the bag's camera_info.

    Args:
        args: of one camera.
        calibrated: refuse images without a calibration.

    Raises:
        UsageError: for options that do not go with it, or that are missing.
    """
    path, camera = args.recording, given_lens(args)
    if is_bag(path):
        if args.rate is not None:
            raise UsageError("--rate is for videos and folders; a bag has its own times")
        topics, info = remapped(args), None
        with open_bag(path) as bag:
            topic = bag.find_topic(IMAGE_TYPES, topics.get(IMAGE), "-r image:=TOPIC")
            if camera is None and (calibrated or CAMERA_INFO_TYPE in bag.topics.values()):
                option = "-r camera_info:=TOPIC, or give --camera FILE"
                info = bag.find_topic((CAMERA_INFO_TYPE,), topics.get(CAMERA_INFO), option)
            yield Source(_with_bar(from_bag(bag, topic, info, camera), bag.count([topic])), None)
        return
    if args.remaps:
        raise UsageError("-r names topics of a bag")
    clock, total, files = ImageClock(args.rate), None, image_files(path) if path.is_dir() else []
    if camera is None and calibrated:
        raise UsageError("a video or folder has no camera_info: give --camera")
    if files:
        if args.rate is None and name_times(files) is None:
            raise UsageError("the names of the files are not times: give --rate")
        shots, total = from_files(files, camera, clock), len(files)
    elif args.rate is None and not has_times(path):
        raise UsageError(
            "this video has no presentation times: give --rate; the readout time scales with it"
        )
    else:
        shots = from_video(path, camera, clock)
    yield Source(_with_bar(shots, total), clock)


def _with_bar(shots: Iterable[Shot | Carried], total: int | None) -> Iterator[Shot | Carried]:
    with tqdm(total=total, unit="image", disable=None) as bar:
        for shot in shots:
            yield shot
            bar.update(isinstance(shot, Shot))


def each_image(
    args: ImageOptions, direction: str, calibrated: bool = True
) -> Iterator[tuple[Image, Camera | None]]:
    """Yield the images of a recording, each with its lens, and then say how they were taken."""
    tally = ImageTally()
    with opened(args, calibrated) as source:
        for _, image, camera in usable(source.shots, direction, tally):
            yield image, camera
    print_images(tally.refused, source.clock)


def recorded(
    args: LensOptions, bag: BagReader, config: NodeConfig, landmarks: Map | None
) -> tuple[Camera, tuple[Correspondences, ...]]:
    """Return the lens of a bag, and its correspondences with the map that it saw."""
    topics = find_topics(bag, given_topics(args)).without(IMU)
    found = read_recording(bag, topics, landmarks)
    return given_lens(args) or found.calibration.camera(0.0, config.scan_direction), found.clouds


T = TypeVar("T", bound=LensOptions)


def check_there(recordings: Sequence[Path]) -> None:
    """Raise ValueError for one that does not exist, before any other has been read."""
    for path in recordings:
        if not path.exists():
            raise ValueError(f"{path} does not exist")


def cameras_of(args: T, recordings: Sequence[Path], config: NodeConfig) -> dict[str, tuple[T, str]]:
    """Return the cameras of one bag, or of a recording of each, by name.

    Of each: the options of a recording of this camera alone, and the frame of its optical axes.
    """
    found = [
        (re.sub(r"\W", "_", path.stem, flags=re.ASCII), dict[str, Any](recording=path), "")
        for path in recordings
    ]
    if len(recordings) == 1:
        found = _in_one_bag(recordings[0], config.cameras if config.of_cameras else None)
    names = [name for name, _, _ in found]
    if len(set(names)) < max(len(names), 2) or not all(name[:1].isalpha() for name in names):
        raise UsageError(
            f"--rig: cameras need different names that begin with a letter: {', '.join(names)}"
        )
    check_there(recordings)
    # Single recordings that were put together have one frame.
    differ = len({frame for _, _, frame in found}) == len(found)
    cameras, lens = {}, args.calibration
    for name, own, frame in found:
        calibration = None if lens is None else lens.with_name(f"{lens.name}#{name}")
        alone = replace(args, **own, calibration=calibration)
        cameras[name] = alone, (differ and frame) or f"{name}_optical_frame"
    return cameras


def _in_one_bag(path: Path, given: Sequence[str] | None) -> list[tuple[str, dict[str, Any], str]]:
    """Return name, topics as options, and frame of each camera of a bag."""
    if not is_bag(path):
        raise UsageError(f"--rig needs the recordings of several cameras, or one bag; got {path}")
    with open_bag(path) as bag:
        return [
            (
                name,
                {"recording": path, "remaps": [f"{it}:={topic}" for it, topic in own.items()]},
                next((m.header.frame_id for *_, m in bag.messages([own[CAMERA_INFO]])), ""),
            )
            for name, own in camera_topics(bag, given).items()
        ]


@dataclass(frozen=True, kw_only=True)
class TargetOptions:
    """what to look for: a map of markers, or one board."""

    map: Path | None = option("marker map; also that of keypoints, where they are read", "FILE")
    board: str | None = option("instead: inner corners along a row x rows of a chessboard", "6x4")
    square: float | None = option("side of its squares in metres", "M", above=0.0)


def find_map(args: TargetOptions) -> MarkerMap:
    """Return the given map, or the map of the given board.

    Raises:
        UsageError: when it is neither, or both.
    """
    if (args.map is None) == (args.board is None):
        raise UsageError("give either --map or --board")
    if args.map is not None:
        if args.square is not None:
            raise UsageError("--square goes with --board")
        return read_marker_map(args.map)
    if args.board is None or args.square is None:
        raise UsageError("--board needs --square")
    columns, rows = read_counts(args.board, "--board")
    try:
        board = Chessboard(columns, rows, args.square)
    except ValueError as error:
        raise UsageError(f"--board: {error}") from error
    # A board on its own is the map: its first corner is the origin, x along the rows, y from row to
    # row, z away from the viewer.
    axes = np.diag([1.0, -1.0, -1.0])
    pose = Pose(-axes @ board.points[0], axes)
    return MarkerMap(boards=(replace(board, pose=pose),))
