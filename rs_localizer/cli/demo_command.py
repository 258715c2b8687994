# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer demo``: bundled recordings localized; tables, pictures, and last a live node."""

from __future__ import annotations

import shlex
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.cli import WORKING, import_ros, stage
from rs_localizer.cli.options import option
from rs_localizer.cli.typed import typed
from rs_localizer.config import NodeConfig
from rs_localizer.tools.simulation.simulated_settings import FrameSettings

if WORKING:
    from scipy.spatial.transform import Rotation

    from rs_localizer import data
    from rs_localizer.core.camera import Camera
    from rs_localizer.core.shutter import Motion
    from rs_localizer.io.atomic_files import atomic_files
    from rs_localizer.io.bags import open_bag
    from rs_localizer.io.camera_info import read_camera_info
    from rs_localizer.io.messages import stamp_ns
    from rs_localizer.io.outputs import Localized
    from rs_localizer.io.recording import (
        CAMERA_INFO_TOPIC,
        CORRESPONDENCES_TOPIC,
        make_camera_info,
        make_correspondences,
    )
    from rs_localizer.io.trajectories import Motions, Trajectory, Twists, read_tum
    from rs_localizer.offline.results import Track
    from rs_localizer.pipeline.frames import FrameLocalizer
    from rs_localizer.settings import build, load_params_file
    from rs_localizer.tools import cube_clip, errors
    from rs_localizer.tools.simulation.scene import room
    from rs_localizer.tools.simulation.simulated_frames import (
        frame_stamps,
        middle_stamp,
        simulate_frames,
    )
    from rs_localizer.tools.simulation.true_motion import RecordedMotion, TrueMotion

# The part of the hand's motion that is flown (s): it begins slowly and ends in quick turns.
_FLIGHT_START, _FLIGHT_DURATION = 8.0, 18.0
_QUICK_FRAMES = 12
_SEEN = FrameSettings()
_METHODS = (NodeConfig().solver, "p3p")

_AFTERWARDS = """
Your own camera, next:
  {rs_localizer} markers make board --help            print a board
  {rs_localizer} calibrate video.mp4 --board 9x6 --square 0.025 --out shutter.yaml
  {localizer} --ros-args --params-file shutter.yaml   the node (docs/node.md)
"""


@dataclass(frozen=True, kw_only=True)
class Options:
    out: Path = option("for the pictures", "DIR", Path("out"))
    quick: bool = option("a few frames of each recording only", default=False)


class FrameMessages(NamedTuple):
    """Messages of a frame."""

    stamp_ns: int
    info: Any  # sensor_msgs/CameraInfo
    cloud: Any  # sensor_msgs/PointCloud2


Answers = Mapping[str, Mapping[int, "Localized"]]
"""Localized frames by method, the rolling shutter's first, and stamp."""


def run(options: Options) -> None:
    started = time.monotonic()
    options.out.mkdir(parents=True, exist_ok=True)
    most = _QUICK_FRAMES if options.quick else None
    print(
        f"about 1 min; 0.5 GB of memory, 5 MB in {options.out}",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as directory:
        camera, hand = cube_clip.CAMERA, read_tum(data.path(data.HAND_MOTION))
        motion = RecordedMotion(hand)
        flight = _fly(camera, motion, most)
        true = _true(camera, motion, flight)
        answers = _localized("Simulated flight", flight, camera.readout_time, true)
        picture = options.out / "flight_errors.png"
        found_errors = {name: _errors(found, true) for name, found in answers.items()}
        with atomic_files(picture) as (part,):
            errors.draw(found_errors, part)
        print(picture, flush=True)
        webcam = read_frames(data.path(data.WEBCAM), most)
        settings = build(load_params_file(data.path(data.WEBCAM) / "parameters.yaml"))
        _localized("Webcam over a board", webcam, settings.readout_time, None)
        _cube(cube_clip.Walls(hand), most, options.out / "cube.gif")
        _live(flight, answers[_METHODS[0]], camera.readout_time, Path(directory) / "node.log")
    afterwards = _AFTERWARDS.format_map({it: typed(it) for it in ("rs_localizer", "localizer")})
    print(f"done in {time.monotonic() - started:.0f} s\n{afterwards}", end="")


def read_frames(path: Path, most: int | None = None) -> list[FrameMessages]:
    """The frames, or the first ones, of a recording of correspondences.

    Raises:
        BagError: when it cannot be read.
    """
    frames, info = list[FrameMessages](), None
    with open_bag(path) as bag:
        for topic, _, message in bag.messages({CAMERA_INFO_TOPIC, CORRESPONDENCES_TOPIC}):
            if topic == CAMERA_INFO_TOPIC:
                info = message
            else:
                frames.append(FrameMessages(stamp_ns(message), info, message))
    return frames[:most]


def _fly(camera: Camera, motion: RecordedMotion, most: int | None) -> list[FrameMessages]:
    start_ns = motion.intervals_ns[0][0] + round(_FLIGHT_START * 1e9)
    first, last = np.searchsorted(
        stamps := frame_stamps(motion, camera, _SEEN.rate),
        [start_ns, start_ns + round(_FLIGHT_DURATION * 1e9)],
    )
    path = motion.state(start_ns, np.linspace(0.0, _FLIGHT_DURATION, 200)).positions
    scene, frames = room(path, np.random.default_rng(0)), list[FrameMessages]()
    stamps = stamps[first:last][:most]
    with stage("Simulating a flight along a hand's motion", len(stamps)) as step:
        for seen in simulate_frames(camera, motion, scene, _SEEN, stamps_ns=stamps):
            cloud = make_correspondences(seen.stamp_ns, seen.points, seen.pixels, seen.ids)
            frames.append(
                FrameMessages(seen.stamp_ns, make_camera_info(camera, seen.stamp_ns), cloud)
            )
            step(1)
    return frames


def _true(camera: Camera, motion: TrueMotion, frames: Sequence[FrameMessages]) -> Motions:
    """The camera at the middle rows."""
    stamps = np.array([middle_stamp(camera, frame.stamp_ns) for frame in frames], np.int64)
    state = motion.state(int(stamps[0]), 1e-9 * (stamps - stamps[0]))
    quaternions = Rotation.from_matrix(state.rotations).as_quat()
    return Motions(
        Trajectory(stamps, state.positions, quaternions),
        Twists(stamps, state.angular, state.linear),
    )


def _localized(
    title: str, frames: Sequence[FrameMessages], readout_time: float, true: Motions | None
) -> Answers:
    """The frames by all methods, as a node localizes them, and a table of what came of it."""
    answers, rows = dict[str, dict[int, Localized]](), dict[str, np.ndarray]()
    for solver in _METHODS:
        localizer = FrameLocalizer(build(_settings(solver, readout_time)))
        answers[solver] = found = dict[int, Localized]()
        with stage(f"{title}, {solver}", len(frames)) as step:
            for stamp, info, cloud in frames:
                localizer.calibrate(read_camera_info(info))
                if frame := localizer.localize(cloud):
                    found[stamp] = frame
                step(1)
        values = [frame.inliers["residual"].astype(float) for frame in found.values()]
        rows[f"inliers, {solver}"] = np.array([len(each) for each in values])
        rows[f"residual (px rms), {solver}"] = np.array(
            [np.sqrt(np.mean(each**2)) for each in values]
        )
        for kind, each in (_errors(found, true) if true else {}).items():
            rows[f"{kind} ({errors.UNITS[kind]}), {solver}"] = each.values
    order = sorted(rows, key=lambda name: list(rows).index(name.replace("p3p", _METHODS[0])))
    title = f"{title}, {len(frames)} frames"
    print(f"\n{errors.table({name: rows[name] for name in order}, title)}\n", flush=True)
    return answers


def _errors(found: Mapping[int, Localized], true: Motions) -> dict[str, errors.Errors]:
    track = Track()
    for frame in found.values():
        track.add(frame)
    return errors.errors_of(track.motions(), true)


def _settings(solver: str, readout_time: float) -> dict[str, Any]:
    return {"solver": solver, "readout_time": readout_time, "pose_time": "mid_frame"}


def _cube(walls: cube_clip.Walls, most: int | None, out: Path) -> None:
    """Walls of markers, filmed and detected, and the cube there by the poses of both methods."""
    stamps, camera = walls.stamps(most), cube_clip.CAMERA
    images, frames = [], list[FrameMessages]()
    with stage("Rendering walls of markers", len(stamps)) as step:
        for stamp, (image, seen) in zip(stamps, walls.film(stamps), strict=True):
            images.append(image)
            cloud = make_correspondences(stamp, seen.points, seen.pixels, seen.ids)
            frames.append(FrameMessages(stamp, make_camera_info(camera, stamp), cloud))
            step(1)
    true = _true(camera, walls.motion, frames)
    answers = _localized("Walls of markers", frames, camera.readout_time, true)
    ours, p3p = (
        [found.get(stamp) for stamp in stamps[cube_clip.RUN_UP :]] for found in answers.values()
    )
    shown = slice(cube_clip.RUN_UP, None)
    motions: dict[str, list[Motion | None]] = {
        "P3P: one pose per image": [frame and frame.estimate for frame in p3p],
        "ours: a pose for every row": [frame and frame.estimate for frame in ours],
    }
    animation, off = cube_clip.clip(walls, images[shown], stamps[shown], motions)
    with atomic_files(out) as (part,):
        part.write_bytes(animation)
    theirs, own = (np.median(each) for each in off.values())
    print(
        f"The cube's farthest corner is off by {own:.2f} px in the median, by {theirs:.1f} px with "
        f"P3P.\n{out}",
        flush=True,
    )


def _live(
    frames: Sequence[FrameMessages],
    answers: Mapping[int, Localized],
    readout_time: float,
    log: Path,
) -> None:
    """The flight once more through a live node, which says the same."""
    try:
        live = import_ros("live", "a live node")
    except ValueError as error:
        print(f"left out: {error}")
        return
    known, same, late = 0, 0, list[float]()
    print("Starting a live node", flush=True)
    try:
        with live.LiveNode(
            _settings(_METHODS[0], readout_time), log, round(0.5e9 * readout_time)
        ) as node:
            node.wait(lambda line: print(f"  {line}", flush=True))
            with stage("The flight through a live node", len(frames)) as step:
                for stamp, info, cloud in frames:
                    began, answer = time.perf_counter(), answers.get(stamp)
                    pose = node.localize(info, cloud)
                    late.append(time.perf_counter() - began)
                    step(1)
                    known += pose is not None
                    if pose is None or answer is None:
                        same += pose is answer
                        continue
                    there = pose.pose.position
                    same += answer.pose.position.tolist() == [there.x, there.y, there.z]
    except live.LiveError as error:
        again = shlex.join(["rs_localizer", *sys.argv[1:]])
        print(error)
        raise ValueError(f"no live node; tables and pictures are there; again: {again}") from error
    p50, p95 = np.percentile(1e3 * np.array(late), [50, 95])
    print(
        f"The live node has answered {known} of {len(frames)} frames, {same} as above to the last "
        f"bit; {p50:.1f} ms from message to pose, 95 % within {p95:.1f} ms"
    )
