# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The cameras of a rig: which recording and topics are whose, and how they are mounted."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Generic, TypeVar

from rs_localizer.cli import WORKING
from rs_localizer.cli.image_input import LensOptions
from rs_localizer.cli.options import UsageError

if WORKING:
    import numpy as np
    from scipy.spatial.transform import Rotation

    from rs_localizer.config import CameraSettings, NodeConfig
    from rs_localizer.core.arrays import Array
    from rs_localizer.io.bags import is_bag, open_bag
    from rs_localizer.io.rigs import read_camchain
    from rs_localizer.io.transforms import Transform
    from rs_localizer.offline.recordings import camera_topics, optical_frame, transform_between
    from rs_localizer.tools.adjust.variables import Extrinsics, MountPrior
    from rs_localizer.tools.rig_mounts import DETERMINED
    from rs_localizer.tools.verdict import numbers


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
    found: list[tuple[str, dict[str, Any], str]]
    if len(recordings) > 1:
        found = [
            (re.sub(r"\W", "_", path.stem, flags=re.ASCII), {"recording": path}, "")
            for path in recordings
        ]
    else:
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
                optical_frame(bag, own["camera_info"]),
            )
            for name, own in camera_topics(bag, given).items()
        ]


def mounting_lines(name: str, first: str, mounted: Extrinsics, deviations: Array) -> list[str]:
    """Describe a camera's mount beside the first one, and its clock; deviations (7,) rad, m, s."""
    turn = Rotation.from_matrix(mounted.axes).as_quat(canonical=True)
    turned, moved = np.degrees(deviations[:3]), 1e3 * deviations[3:6]
    return [
        f"{f'{name} <- {first}':26} {numbers(turn, 5)} (x y z w) +- {numbers(turned, 3)} deg",
        f"{f'place in {first}':26} {numbers(1e3 * mounted.centre, 2)} +- {numbers(moved, 2)} mm",
        f"{'offset of its stamps':26} {1e3 * mounted.offset:+.3f} +- {1e3 * deviations[6]:.3f} ms",
    ]


# The input that a map is made from.


@dataclass(frozen=True, slots=True, eq=False)
class MapCamera(Generic[T]):
    """A camera that a map is made with, alone or of a rig."""

    name: str  # empty: it is alone
    args: T  # with its recording and topics
    config: NodeConfig  # with its shutter and clock
    mounting: MountPrior | None  # None: the axes are its own


def map_cameras(args: T, recordings: Sequence[Path], config: NodeConfig) -> list[MapCamera[T]]:
    """Return the cameras of recordings; those of a rig in the axes of the first.

    Raises:
        UsageError: when it is not known how they are mounted, or what their shutters are.
    """
    if len(recordings) == 1 and not config.of_cameras:
        check_there(recordings)
        alone = replace(args, recording=recordings[0])
        return [MapCamera("", alone, config, None)]
    sources = cameras_of(args, recordings, config)
    if args.calibration is not None:
        parts = read_camchain(args.calibration)
        known = [name for name in sources if name in parts.cameras]
        given = {name: Transform(*parts.camera_from_rig[name]) for name in known}
        shutters = {
            name: CameraSettings(
                camera.readout_time, camera.scan_direction, parts.time_offset.get(name, 0.0)
            )
            for name, camera in parts.cameras.items()
        } | dict(config.of_cameras)
    else:
        given, shutters = _by_tf(sources), dict(config.of_cameras)
    if lacking := [name for name in sources if name not in given]:
        raise UsageError(
            f"it is not known where {', '.join(lacking)} of the rig is mounted: give --camera "
            "CAMCHAIN, or a bag with TF; calibrate --rig finds it"
        )
    if lacking := [name for name in sources if not shutters[name].readout_time > 0.0]:
        raise UsageError(f"no readout_time of {', '.join(lacking)}: calibrate --rig finds it")
    first = given[next(iter(sources))].inverse()
    cameras = list[MapCamera[T]]()
    for name, (own, _) in sources.items():
        pose, mounting = given[name] @ first, None
        if cameras:
            extrinsics = Extrinsics(pose.rotation, -pose.rotation.T @ pose.translation, 0.0)
            mounting = MountPrior(extrinsics, np.repeat(DETERMINED, [3, 3, 1]))
        cameras.append(MapCamera(name, own, replace(config, **asdict(shutters[name])), mounting))
    return cameras


def _by_tf(sources: Mapping[str, tuple[LensOptions, str]]) -> dict[str, Transform]:
    """Return poses of the cameras by TF of a bag, in the axes of the first of them."""
    args, first = next(iter(sources.values()))
    if not is_bag(args.recording):
        return {}
    with open_bag(args.recording) as bag:
        poses = {name: transform_between(bag, own, first) for name, (_, own) in sources.items()}
    return {name: pose for name, pose in poses.items() if pose is not None}
