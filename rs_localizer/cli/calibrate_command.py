# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer calibrate``: a recording in motion -> readout time, direction, and the lens."""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rs_localizer.cli import refuse_existing, typed, write_all
from rs_localizer.cli.calibration_input import CalibrationInput, InputOptions, read_input
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.cli.recording_input import cameras_of, given_values
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.io import rigs
from rs_localizer.io.camera_files import lens_parameters, write_calibration
from rs_localizer.io.rigs import RigParts
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.offline.tasks import Figures
from rs_localizer.settings import build, write_parameters
from rs_localizer.tools import verdict
from rs_localizer.tools.camera_calibration import (
    CameraCalibration,
    calibrate,
    calibrate_either_axis,
)  # fmt: skip
from rs_localizer.tools.rig_mounts import calibrate_rig

# Names of the files beside FILE.yaml, after FILE_.
_MAP, _TRANSFORMS = "map.yaml", "transforms.launch.xml"
Writers = dict[Path, Callable[[Path], object]]


@dataclass(frozen=True, kw_only=True)
class Options(InputOptions, ResultOptions):
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
    out: Path | None = option(
        "all that is known of the camera or the rig, lens and shutter: --camera of the other "
        "commands, params file and camera_file of the node", "FILE.yaml",
    )  # fmt: skip
    camera_info: Path | None = option(
        "also the lens alone, for ROS drivers (of a rig, FILE_NAME for each)", "FILE"
    )


def run(options: Options) -> Mapping[str, object]:
    out = options.out
    if out is not None and out.suffix not in (".yaml", ".yml"):
        raise UsageError(f"--out must end in .yaml, got {out}")
    if options.camera_info is not None and out is None:
        raise UsageError("--camera-info goes with --out")
    if options.rig:
        if options.imu:
            raise UsageError("--imu is for one camera: leave it out with --rig")
        # Cameras by name need a readout time; what it is does not matter where it is estimated.
        options = replace(options, assignments=["readout_time:=0.03", *options.assignments])
    elif len(options.recordings) > 1:
        raise UsageError("several recordings are those of a --rig")
    given = given_values(options)
    config = build(given)
    any_axis = not any(name.rpartition(".")[2] == "scan_direction" for name in given)
    cameras = {"": (replace(options, recording=options.recordings[0]), "")}
    if options.rig:
        cameras = cameras_of(options, options.recordings, config)
    if out is not None:
        beside = [_beside(out, _TRANSFORMS)] if options.rig else []
        if not options.rig and (options.map is not None or options.board is not None):
            beside = [_beside(out, _MAP)]
        refuse_existing(options, out, *beside, *_lens_files(options, cameras).values())
    sources, found = dict[str, CalibrationInput](), dict[str, CameraCalibration]()
    for name, (own, _) in cameras.items():
        if name:
            print(f"{name}:")
        axis = config.of_cameras.get(name, config).scan_direction
        source = read_input(own, replace(config, scan_direction=axis))
        sources[name] = replace(source, camera=replace(source.camera, scan_direction=axis))
        found[name] = _calibrated(own, sources[name], config, any_axis)
    if options.rig:
        _mount(options, sources, found, config, {name: of for name, (_, of) in cameras.items()})
        return {name: _figures(each) for name, each in found.items()}
    if refusal := verdict.lens_refusal(found[""]):
        raise ValueError(refusal)
    refusal = found[""].disbelief
    if out is not None:
        refusal = _write(cameras[""][0], out, found[""], sources[""], config, refusal)
    if refusal:
        raise ValueError(refusal)
    return _figures(found[""])


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


def _lens_files(args: Options, names: Iterable[str]) -> dict[str, Path]:
    """Return the files of single lenses, if they are wanted; of a rig's camera ``FILE_NAME``."""
    if (file := args.camera_info) is None:
        return {}
    return {name: file.with_stem(f"{file.stem}_{name}") if name else file for name in names}


def _lens_writers(args: Options, cameras: Mapping[str, Camera]) -> Writers:
    files = _lens_files(args, cameras)
    return {files[name]: partial(write_calibration, camera=cameras[name]) for name in files}


def _calibrated(
    args: Options, source: CalibrationInput, config: NodeConfig, any_axis: bool
) -> CameraCalibration:
    """Calibrate a camera by its images and print the result; ``any_axis``: none was given."""
    one = calibrate_either_axis if any_axis else calibrate
    found = one(
        source.camera, source.images, intrinsics=source.find_lens, imu=source.imu,
        own_stamps=source.own_stamps,
    )  # fmt: skip
    print("\n".join(verdict.table(found, args.rate)))
    if source.find_lens:
        print("\n".join(verdict.of_lens(found)))
    if source.imu is not None:
        print("\n".join(verdict.of_imu(found, config.stamp_offset)))
    return found


def _write(
    args: Options, out: Path, found: CameraCalibration, source: CalibrationInput,
    config: NodeConfig, refused: str,
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
        if found.mount is not None and found.mount.determined[0]:
            values["imu.time_offset"] = found.mount.time_offset + config.stamp_offset
    if config.stamp_offset:
        values["stamp_offset"] = config.stamp_offset
    writers = Writers()
    if marker_map is not None:
        if free := found.fit.freedom.landmarks > 0.0:  # of the map's shape
            places = verdict.moved(found, marker_map.points)
            marker_map = marker_map.with_points(places, found.shape_deviation)
        if free or shape is None:
            shape = _beside(out, _MAP)
            writers[shape] = partial(write_marker_map, marker_map=marker_map)
    if refused and not writers and not source.find_lens:
        return refused
    values |= verdict.deviations(
        [found] if source.find_lens else [], [] if marker_map is None else [marker_map], config
    )
    remarks = [f"readout_time {refused}"] if refused else []
    lens = lens_parameters(found.fit.camera)
    write = partial(write_parameters, values=values, lens=lens, remarks=remarks)
    write_all({**writers, **_lens_writers(args, {"": found.fit.camera}), out: write})
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
    print(f"next: {typed(*words)}")
    return refused


def _mount(
    args: Options, sources: Mapping[str, CalibrationInput], found: Mapping[str, CameraCalibration],
    config: NodeConfig, frames: Mapping[str, str],
) -> None:  # fmt: skip
    """Find how cameras that are calibrated are mounted on a rig, print it and write it."""
    said = {name: verdict.lens_refusal(one) or one.disbelief for name, one in found.items()}
    if refusals := [f"{name}: {text}" for name, text in said.items() if text]:
        raise ValueError("; ".join(refusals))
    rig, comments = calibrate_rig(found), list[str]()
    first, *others = rig
    for name in others:
        comments += verdict.of_mount(name, first, rig[name])
    print("\n".join(comments))
    if refusals := [f"{name}: {one.undetermined}" for name, one in rig.items() if one.undetermined]:
        raise ValueError(f"not observable: {'; '.join(refusals)}")
    if args.out is None:
        return
    alone = list(found.values()) if any(one.find_lens for one in sources.values()) else []
    maps = [one.map for one in sources.values() if one.map is not None]
    cameras = {}
    for name, one in rig.items():
        known = 0.0 if found[name].global_shutter else abs(one.readout_time)
        direction = verdict.scan_direction(found[name])
        cameras[name] = replace(one.camera, readout_time=known, scan_direction=direction)
    # In the axes of the first camera and by its clock.
    mounts = {name: one.extrinsics for name, one in rig.items()}
    base = config.of_cameras.get(first, config).stamp_offset
    parts = RigParts(
        cameras,
        {name: (own.axes, -own.axes @ own.centre) for name, own in mounts.items()},
        {name: base + own.offset for name, own in mounts.items()},
    )
    values = rigs.node_parameters(parts) | verdict.deviations(alone, maps, config)
    place, lens = _beside(args.out, _TRANSFORMS), rigs.mounted_lenses(parts)
    write_all({
        place: partial(rigs.write_static_transforms, parts=parts, frames=frames),
        **_lens_writers(args, cameras),
        args.out: partial(write_parameters, values=values, lens=lens, remarks=comments),
    })  # fmt: skip
    when = "next" if shutil.which("ros2") else "next, in a ROS 2 workspace"
    print(f"{when}: {shlex.join(['ros2', 'launch', str(place)])}")
