# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer map refine``: a map adjusted with the rolling shutter that saw it."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from rs_localizer.cli import WORKING, refuse_existing, write_all
from rs_localizer.cli.map import ReadoutOptions, check_readout, colmap, print_step
from rs_localizer.cli.map.colmap import ColmapOptions
from rs_localizer.cli.options import CAMERA_FLAGS, Inputs, Settings, UsageError, argument, option
from rs_localizer.cli.rig_input import (
    MapCamera,
    MountingOptions,
    map_cameras,
    mounting_lines,
)
from rs_localizer.cli.settings_args import given_settings, given_topics
from rs_localizer.io.maps.files import SUFFIX, read_map_file, write_npz
from rs_localizer.io.topics import IMU

if WORKING:
    import numpy as np
    from tqdm import tqdm

    from rs_localizer.core.arrays import Array
    from rs_localizer.io.bags import open_bag
    from rs_localizer.io.calibration import read_calibration, write_calibration
    from rs_localizer.io.clouds import Correspondences
    from rs_localizer.io.maps.landmarks import Map
    from rs_localizer.offline.recordings import read_recording
    from rs_localizer.offline.replay import find_topics
    from rs_localizer.tools.mapping.observations import RecordedMap, RigCamera, from_recordings
    from rs_localizer.tools.mapping.refine import MapFreedom, RefinedMap, refine_rig

_GIVEN, _ESTIMATED, _GLOBAL = "given", "estimated", "global"
_HOLD = 0.001


@dataclass(frozen=True, kw_only=True)
class Options(ReadoutOptions, MountingOptions, ColmapOptions, Settings, Inputs):
    recordings: list[Path] = argument("a bag of correspondences or keypoints", "RECORDING", list)
    map: Path | None = option("the map (default: the points of the recording)", "MAP")
    out: Path | None = option(f"ends in {SUFFIX}", "OUT")
    overwrite: bool = option("replace OUT", default=False)
    shutter: str | None = option(
        "the readout time: as set, to be found, or none (default: as set, found if it is 0)",
        choices=(_GIVEN, _ESTIMATED, _GLOBAL),
    )
    intrinsics: bool = option("adjust the lens as well", default=False)
    hold: list[int] = option(
        "landmarks of known place, three or more: they hold frame and size of the map (default: "
        "the map as a whole stays where it is, with the size that it has)", "ID ...", list,
    )  # fmt: skip
    hold_deviation: float = option(
        "how well these are known", "M", _HOLD, limits=(0.0, math.inf), above=True
    )
    calibration: Path | None = option(
        "instead of camera_info; of a rig, a camchain as calibrate --rig writes it",
        "FILE",
        flag=CAMERA_FLAGS,
    )


def run(args: Options) -> None:
    if args.colmap is not None:
        colmap.run(args)
        return
    if not args.recordings or args.out is None:
        raise UsageError("give RECORDING and --out OUT, or --colmap IN OUT")
    if args.out.suffix != SUFFIX:
        raise UsageError(f"--out must end in {SUFFIX}, got {args.out}")
    config = given_settings(args)
    refuse_existing(args)
    landmarks = None if args.map is None else read_map_file(args.map, config.map_frame)
    cameras = map_cameras(args, config)
    known = all(of.config.readout_time > 0.0 for of in cameras)
    shutter = args.shutter or (_GIVEN if known else _ESTIMATED)
    if shutter == _GIVEN and not known:
        raise UsageError("--shutter given needs -p readout_time:=S or --params")
    rig, clouds = zip(*(_recorded(of, landmarks, shutter) for of in cameras), strict=True)
    with tqdm(total=sum(map(len, clouds)), unit="image", desc="localize", disable=None) as bar:
        localized = from_recordings([one.camera for one in rig], clouds, landmarks, bar.update)
    deviations = _deviations(args, localized.landmarks, config.map_deviation)
    freedom = MapFreedom(shutter == _ESTIMATED, args.intrinsics, deviations)
    refined = refine_rig(rig, localized.seen, localized.start, freedom, done=print_step)
    _tell(localized, refined, [of.name for of in cameras])
    for of, result in zip(cameras, refined.cameras, strict=True):
        check_readout(args, result.readout_check, "see --shutter estimated", of.name)
    _write(args, localized.landmarks, refined, [of.name for of in cameras])


def _recorded(
    of: MapCamera, landmarks: Map | None, shutter: str
) -> tuple[RigCamera, tuple[Correspondences, ...]]:
    """A camera, and what it saw of the map."""
    config, args = of.config, of.args
    with open_bag(args.recording) as bag:
        topics = find_topics(bag, given_topics(args)).without(IMU)
        recorded = read_recording(bag, topics, config.matching, landmarks)
    readout_time = 0.0 if shutter == _GLOBAL else config.readout_time
    camera = recorded.calibration.camera(readout_time, config.scan_direction)
    if args.calibration is not None:
        lens = read_calibration(args.calibration)
        camera = replace(lens, readout_time=readout_time, scan_direction=config.scan_direction)
    return RigCamera(camera, config.stamp_offset, of.mounting), recorded.clouds


def _deviations(args: Options, landmarks: Map, map_deviation: float) -> Array | None:
    """How well each landmark is known, m; None: not at all."""
    every = map_deviation if map_deviation > 0.0 else np.inf
    if not args.hold:
        return np.full(len(landmarks), every) if map_deviation > 0.0 else None
    if landmarks.ids is None:
        raise UsageError("--hold needs a map with ids")
    unknown = sorted(set(args.hold) - set(landmarks.ids.tolist()))
    if unknown:
        raise UsageError(f"--hold: the map has no landmark {unknown[0]}")
    return np.where(np.isin(landmarks.ids, args.hold), args.hold_deviation, every)


def _tell(localized: RecordedMap, refined: RefinedMap, names: Sequence[str]) -> None:
    moved = np.linalg.norm(refined.points - localized.start.points, axis=1)[refined.refined]
    spread = np.sqrt(np.trace(refined.covariances[refined.refined], axis1=1, axis2=2))
    rows = [
        ("images with a pose", f"{len(localized.seen.stamps_ns)} of {localized.images}"),
        ("landmarks refined", f"{np.count_nonzero(refined.refined)} of {len(refined.points)}"),
        ("noise before", f"{refined.before:.3f} px"),
        ("noise after", f"{refined.after:.3f} px"),
        ("keypoints that fit", f"{np.mean(refined.inliers):.1%}"),
    ]
    if len(moved):
        far = f"{1e3 * np.median(moved):.1f} mm (median), {1e3 * moved.max():.1f} at most"
        rows.append(("landmarks moved by", far))
        rows.append(("deviation of a landmark", f"{1e3 * np.median(spread):.1f} mm (median)"))
    for of, camera in zip(names, refined.cameras, strict=True):
        deviation = camera.readout_time_deviation
        spread_text = "" if np.isnan(deviation) else f" +- {1e3 * deviation:.3f}"
        name = f"{of}: readout time" if of else "readout time"
        rows.append((name, f"{1e3 * camera.readout_time:.3f}{spread_text} ms"))
    for name, text in rows:
        print(f"{name:26} {text}")
    for of, camera in zip(names, refined.cameras, strict=True):
        if camera.deviations.any():
            lines = mounting_lines(of, names[0], camera.extrinsics, camera.deviations)
            print("\n".join([*lines[:-1], f"{lines[-1]} besides what is set"]))
        if camera.readout_time < 0.0:
            whose = f"the readout time of {of}" if of else "the readout time"
            print(f"{whose} is negative: the scan direction is the reverse of what was set")


def _write(args: Options, landmarks: Map, result: RefinedMap, names: Sequence[str]) -> None:
    refined = replace(
        landmarks, points=result.points, covariances=result.covariances, error_modes=None
    )
    assert args.out is not None
    writers: dict[Path, Callable[[Path], object]] = {
        args.out: lambda part: write_npz(part, refined)
    }
    for name, camera in zip(names, result.cameras, strict=True) if args.intrinsics else ():
        of = f"{args.out.stem}_{name}" if name else args.out.stem
        lens = args.out.with_name(f"{of}_camera_info.yaml")
        writers[lens] = partial(write_calibration, camera=camera.camera)
    write_all(writers)
    unchanged = np.count_nonzero(~result.refined)
    if unchanged:
        print(
            f"{unchanged} landmarks are unchanged: in fewer than two images, or from "
            "too few sides to be known better"
        )
