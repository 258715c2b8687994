# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer calibrate``: a recording in motion -> readout time, direction, and the lens."""

from __future__ import annotations

import shlex
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rs_localizer.cli import WORKING, image_input, refuse_existing, write_all
from rs_localizer.cli.image_input import ImageOptions, given_lens
from rs_localizer.cli.marker_map import TargetOptions, find_map
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.rig_input import cameras_of, check_there, mounting_lines
from rs_localizer.cli.settings_args import given_settings, given_topics, remapped
from rs_localizer.cli.typed import typed
from rs_localizer.io.topics import CAMERA_INFO, IMAGE, IMU

if WORKING:
    from tqdm import tqdm

    from rs_localizer.config import CalibrationErrors, DetectorConfig, NodeConfig
    from rs_localizer.core.camera import Camera
    from rs_localizer.io import rigs
    from rs_localizer.io.bags import BagReader, is_bag, open_bag
    from rs_localizer.io.camera_files import lens_parameters, write_calibration
    from rs_localizer.io.imu import ImuRecording
    from rs_localizer.io.maps.files import read_map_file
    from rs_localizer.io.rigs import RigParts
    from rs_localizer.localizer import Localizer
    from rs_localizer.markers.map_files import write_marker_map
    from rs_localizer.markers.maps import MarkerMap
    from rs_localizer.offline.detect import ImageTally, usable
    from rs_localizer.offline.fleet import Figures
    from rs_localizer.offline.image_sources import Carried, Shot
    from rs_localizer.offline.recordings import optical_frame, read_imu_recording, read_recording
    from rs_localizer.offline.replay import find_topics, has_frames
    from rs_localizer.pipeline.marker_detector import FrameDetector
    from rs_localizer.pipeline.what_fits import ids_of, mistake_of
    from rs_localizer.settings import write_camera_file
    from rs_localizer.tools import verdict
    from rs_localizer.tools.adjust.intrinsics import LensErrors
    from rs_localizer.tools.adjust.observe import ImagePoints, in_order
    from rs_localizer.tools.camera_calibration import CameraCalibration, calibrate
    from rs_localizer.tools.first_lens import first_lens
    from rs_localizer.tools.rig_mounts import Mounted, Recording, calibrate_rig

# Names of the files beside FILE.yaml, after FILE_.
_MAP, _TRANSFORMS = "map.yaml", "transforms.launch.xml"
Writers = dict[Path, Callable[[Path], object]]


@dataclass(frozen=True, kw_only=True)
class Options(TargetOptions, ImageOptions, ResultOptions):
    recordings: list[Path] = argument(
        "a bag of correspondences or keypoints; or, with --map or --board, images: a video, a "
        "folder, a bag; several with --rig", "RECORDING",
    )  # fmt: skip
    rig: bool = option(
        "the recordings are those of cameras on one body, one each, or one bag has topics of "
        "several: find where the cameras are, and their clocks, too; the first one's axes and "
        "clock are the rig's. Cameras are named as their files, or as their topics begin; so are "
        "the lenses of --camera", default=False,
    )  # fmt: skip
    intrinsics: bool = option("find the lens as well", default=False)
    imu: bool = option(
        "find how the IMU of a bag goes with the camera: offset of its stamps, rotation, bias",
        default=False,
    )  # fmt: skip
    out: Path | None = option(
        "all that is known of the camera or the rig, lens and shutter: --camera of the other "
        "commands, params file and camera_file of the node", "FILE.yaml",
    )  # fmt: skip
    camera_info: Path | None = option(
        "also the lens alone, for ROS drivers (of a rig, FILE_NAME for each)", "FILE"
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Input:
    """Images with correspondences, and their camera."""

    images: list[ImagePoints]
    camera: Camera
    find_lens: bool  # it is to be found, or a first guess of this command
    imu: ImuRecording | None = None
    map: MarkerMap | None = None  # of images
    own_stamps: bool = True


def run(options: Options) -> Mapping[str, object]:
    if options.out is not None and options.out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out must end in .yaml, got {options.out}")
    if options.camera_info is not None and options.out is None:
        raise UsageError("--camera-info goes with --out")
    if options.rig:
        return _calibrate_rig(options)
    if len(options.recordings) > 1:
        raise UsageError("several recordings are those of a --rig")
    return _calibrate_one(replace(options, recording=options.recordings[0]))


def _calibrate_one(args: Options) -> Figures:
    """Calibrate with one recording, and say what was found."""
    if args.out is not None:
        of_images = args.map is not None or args.board is not None
        maps = [_beside(args.out, _MAP)] if of_images else []
        refuse_existing(args, args.out, *maps, *_lens_file(args, ""))
    config = given_settings(args)
    source = _read(args, config)
    camera = replace(source.camera, scan_direction=config.scan_direction)
    found = _calibrated(args, source, camera, config)
    refusal = verdict.refusal(found)
    if args.out is not None and not verdict.lens_refusal(found):
        refusal = _write(args, args.out, found, source, config, refusal)
    if refusal:
        raise ValueError(refusal)
    return _figures(found)


def _figures(found: CameraCalibration) -> Figures:
    return {
        "readout_time_ms": 1e3 * verdict.readout_time(found),
        "deviation_ms": 1e3 * found.deviation,
        "scan_direction": str(verdict.scan_direction(found)),
        "images": found.images,
        "with_a_pose": len(found.posed.times),
        "noise_px": float(found.fit.deviation),
    }


def _beside(out: Path, name: str) -> Path:
    """Return the path of a file beside ``OUT.yaml``, as ``OUT_map.yaml``."""
    return out.with_name(f"{out.stem}_{name}")


def _lens_file(args: Options, name: str) -> list[Path]:
    """Return the file of a camera's lens alone, if it is wanted; of a rig ``FILE_NAME``."""
    file = args.camera_info
    return [file.with_stem(f"{file.stem}_{name}") if name else file] if file else []


def _calibrated(
    args: Options, source: _Input, camera: Camera, config: NodeConfig
) -> CameraCalibration:
    """Calibrate a camera by its images and print the result."""
    with tqdm(total=len(source.images), unit="image", desc="localize", disable=None) as bar:
        found = calibrate(
            camera, source.images, intrinsics=source.find_lens, imu=source.imu,
            own_stamps=source.own_stamps, done=bar.update,
        )  # fmt: skip
    print("\n".join(verdict.table(found, args.rate)))
    if source.find_lens:
        print("\n".join(verdict.of_lens(found)))
    if source.imu is not None:
        print("\n".join(verdict.of_imu(found, source.imu, config.stamp_offset)))
    return found


def _read(args: Options, config: NodeConfig) -> _Input:
    path = args.recording
    check_there([path])
    of_bag = is_bag(path)
    imu = _imu(args, path) if args.imu else None
    if of_bag and IMAGE not in remapped(args):
        with open_bag(path) as bag:
            if has_frames(bag):
                if args.rate is not None:
                    raise UsageError("--rate is for images; a bag has its own times")
                return replace(_correspondences(args, bag, config), imu=imu)
    with image_input.opened(args, calibrated=False) as source:
        found = _detected(args, source.shots)
    image_input.print_times(source.clock)
    return replace(found, own_stamps=of_bag or (path.is_dir() and args.rate is None), imu=imu)


def _imu(args: Options, path: Path) -> ImuRecording:
    """Return the readings of the IMU of a bag."""
    if not is_bag(path):
        raise UsageError("--imu is for bags, which have an IMU beside the images")
    with open_bag(path) as bag:
        topics = remapped(args)
        frame = optical_frame(bag, topics.get(CAMERA_INFO))
        return read_imu_recording(bag, topics.get(IMU), frame)


def _correspondences(args: Options, bag: BagReader, config: NodeConfig) -> _Input:
    if args.board is not None:
        raise UsageError("--board is for images; the recording has correspondences")
    topics = find_topics(bag, given_topics(args)).without(IMU)
    landmarks = None if args.map is None else read_map_file(args.map, config.map_frame)
    recorded = read_recording(bag, topics, landmarks)
    camera = given_lens(args) or recorded.calibration.camera(0.0, config.scan_direction)
    frames = [(cloud.points, cloud.pixels, ids_of(cloud)) for cloud in recorded.clouds]
    _warn(mistake_of(Localizer(camera, config), frames))
    images = [ImagePoints(cloud.stamp_ns, cloud.points, cloud.pixels) for cloud in recorded.clouds]
    return _Input(images, camera, args.intrinsics)


def _warn(*faults: str | None) -> None:
    for fault in filter(None, faults):
        print(f"warning: {fault}", file=sys.stderr)


def _detected(args: Options, shots: Iterator[Shot | Carried]) -> _Input:
    marker_map = find_map(args)
    detector = FrameDetector(DetectorConfig(), lambda name, text: None, marker_map)
    images, frames, tally = list[ImagePoints](), [], ImageTally()
    camera: Camera | None = None
    size = (0, 0)
    seen = usable(shots, NodeConfig().scan_direction, tally)
    for _, image, own in tqdm(seen, unit="image", desc="detect", disable=None):
        camera, size = camera or own, image.pixels.shape[::-1]
        found = detector.detect(image).detections
        images.append(ImagePoints(image.stamp_ns, found.points, found.pixels))
        if len(found.points):
            frames.append((found.points, found.pixels, found.ids))
    print(f"{len(frames)} of {len(images)} images show the map")
    image_input.print_left_out(tally.refused)
    _warn(detector.mistake)
    find_lens = args.intrinsics or camera is None
    camera = camera or first_lens(size, in_order(images))
    if not detector.mistake:
        _warn(mistake_of(Localizer(camera), frames))
    return _Input(images, camera, find_lens, map=marker_map)


def _write(
    args: Options, out: Path, found: CameraCalibration, source: _Input, config: NodeConfig,
    refused: str,
) -> str:  # fmt: skip
    """Write FILE.yaml, beside it the map as it was found, and print what comes next.

    Args:
        refused: why the shutter is not known, then it is left out; or ''.

    Returns:
        ``refused``, with what was written in spite of it.
    """
    shape, marker_map = args.map, source.map
    values: dict[str, Any] = {"scan_direction": config.scan_direction}
    if not refused:
        values = {
            "readout_time": verdict.readout_time(found),
            "readout_time_deviation": found.deviation,
            "scan_direction": verdict.scan_direction(found),
        }
        if found.mount is not None and found.mount.time_offset_determined:
            values["imu.time_offset"] = found.mount.time_offset + config.stamp_offset
    if config.stamp_offset:
        values["stamp_offset"] = config.stamp_offset
    writers = Writers()
    if marker_map is not None:
        if verdict.shape_is_free(found):
            places = verdict.moved(found, marker_map.points)
            marker_map = marker_map.with_points(places, found.shape_deviation)
        if verdict.shape_is_free(found) or shape is None:
            shape = _beside(out, _MAP)
            writers[shape] = partial(write_marker_map, marker_map=marker_map)
    if refused and not writers and not source.find_lens:
        return refused
    values |= _deviations(
        [found] if source.find_lens else [], [] if marker_map is None else [marker_map], config
    )
    remarks = [f"readout_time {refused}"] if refused else []
    camera = found.fit.camera
    lens = lens_parameters(camera)
    write = partial(write_camera_file, values=values, lens=lens, remarks=remarks)
    write_all({**writers, **_lens_writers(args, {"": camera}), out: write})
    if refused:
        refused += (
            f"; written to {out} and beside it: lens, map; not written: readout time and "
            "scan direction, which stay unknown: no twists"
        )
    if found.processed:  # the lens is that of a picture that was moved
        return refused
    # The lens of the file replaces the one in camera_info.
    new_lens = source.find_lens or args.calibration is not None
    words = ["replay", str(args.recording), "--camera" if new_lens else "--params", str(out)]
    if shape is not None:  # of images; else the recording has matches
        words += ["--map", str(shape), *(["--rate", str(args.rate)] if args.rate else [])]
        words += [word for text in args.remaps for word in ("-r", text)]
    words += ["--out", f"{out.with_suffix('')}_poses"]
    print(f"next: {typed('rs_localizer', *words)}")
    return refused


def _deviations(
    found: Sequence[CameraCalibration], maps: Sequence[MarkerMap], config: NodeConfig
) -> dict[str, float]:
    """Return the settings of the deviations of lens and map.

    Args:
        found: with lenses that were estimated, of which the worst counts; else those that were
            given hold on.
    """
    errors, known = config.calibration, dict[str, float]()
    if found or errors != CalibrationErrors():
        for name in LensErrors._fields:
            own = [float(getattr(each.lens, name)) for each in found] or [getattr(errors, name)]
            known[f"calibration.{name}"] = float(f"{max(own):.4g}")
    declared = [each.settings.get("map_deviation", 0.0) for each in maps]
    if map_deviation := config.map_deviation or max(declared, default=0.0):
        known["map_deviation"] = float(f"{map_deviation:.3g}")
    return known


def _lens_writers(args: Options, cameras: Mapping[str, Camera]) -> Writers:
    """Return what writes the single lenses, if they are wanted."""
    return {
        file: partial(write_calibration, camera=camera)
        for name, camera in cameras.items()
        for file in _lens_file(args, name)
    }


def _calibrate_rig(args: Options) -> dict[str, Figures]:
    """Calibrate each camera alone, then all together, and say what was found."""
    if args.imu:
        raise UsageError("--imu is for one camera: leave it out with --rig")
    # Cameras by name need a readout time; what it is does not matter where it is estimated.
    args = replace(args, assignments=["readout_time:=0.03", *args.assignments])
    config, recordings, maps = given_settings(args), dict[str, Recording](), list[MarkerMap]()
    cameras = cameras_of(args, args.recordings, config)
    if args.out is not None:
        lenses = [file for name in cameras for file in _lens_file(args, name)]
        refuse_existing(args, args.out, _beside(args.out, _TRANSFORMS), *lenses)
    intrinsics = False
    for name, (own, _) in cameras.items():
        print(f"{name}:")
        axis = config.of_cameras.get(name, config).scan_direction
        source = _read(own, replace(config, scan_direction=axis))
        intrinsics |= source.find_lens
        maps += [] if source.map is None else [source.map]
        camera = replace(source.camera, scan_direction=axis)
        recordings[name] = Recording(camera, _calibrated(own, source, camera, config))
    said = {name: verdict.refusal(each.calibration) for name, each in recordings.items()}
    if refusals := [f"{name}: {text}" for name, text in said.items() if text]:
        raise ValueError("; ".join(refusals))
    rig = calibrate_rig(recordings)
    first, comments = next(iter(rig)), list[str]()
    for name, mounted in list(rig.items())[1:]:
        comments += mounting_lines(name, first, mounted.extrinsics, mounted.deviations)
        print("\n".join(comments[-3:]))
    if refusals := [f"{name}: {one.undetermined}" for name, one in rig.items() if one.undetermined]:
        raise ValueError(f"not observable: {'; '.join(refusals)}")
    if args.out is not None:
        frames = {name: frame for name, (_, frame) in cameras.items()}
        alone = [each.calibration for each in recordings.values()] if intrinsics else []
        parts = _parts(rig, recordings, config)
        values = rigs.node_parameters(parts) | _deviations(alone, maps, config)
        transforms = partial(rigs.write_static_transforms, parts=parts, frames=frames)
        place, lens = _beside(args.out, _TRANSFORMS), rigs.mounted_lenses(parts)
        write = partial(write_camera_file, values=values, lens=lens, remarks=comments)
        single = _lens_writers(args, parts.cameras)
        write_all({place: transforms, **single, args.out: write})
        when = "next" if shutil.which("ros2") else "next, in a ROS 2 workspace"
        print(f"{when}: {shlex.join(['ros2', 'launch', str(place)])}")
    return {name: _figures(each.calibration) for name, each in recordings.items()}


def _parts(
    rig: Mapping[str, Mounted], recordings: Mapping[str, Recording], config: NodeConfig
) -> RigParts:
    """Return the estimated rig in the axes of its first camera and by its clock."""
    cameras = {}
    for name, one in rig.items():
        own = recordings[name].calibration
        cameras[name] = replace(
            one.camera,
            readout_time=0.0 if own.global_shutter else abs(one.readout_time),
            scan_direction=verdict.scan_direction(own),
        )
    mounts = {name: one.extrinsics for name, one in rig.items()}
    poses = {name: (own.axes, -own.axes @ own.centre) for name, own in mounts.items()}
    base = config.of_cameras.get(next(iter(rig)), config).stamp_offset
    offsets = {name: base + own.offset for name, own in mounts.items()}
    return RigParts(cameras, poses, offsets)
