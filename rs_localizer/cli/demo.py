# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer demo``: bundled recordings localized; tables, pictures, and last a live node."""

from __future__ import annotations

import shlex
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.cli import WORKING, import_ros, stage
from rs_localizer.cli.options import option
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.tools.simulation.settings import FrameSettings

if WORKING:
    from scipy.spatial.transform import Rotation

    from rs_localizer import data
    from rs_localizer.core.shutter import Motion
    from rs_localizer.core.simd import compiler
    from rs_localizer.core.simd.jit import cache_directory
    from rs_localizer.io.bags import BagWriter
    from rs_localizer.io.camera_info import read_camera_info
    from rs_localizer.io.recording import write_frame
    from rs_localizer.io.trajectories import read_tum
    from rs_localizer.io.video import Image
    from rs_localizer.pipeline.frames import FrameLocalizer
    from rs_localizer.settings import build, load_params_file
    from rs_localizer.tools.evaluation import cube_clip, plots
    from rs_localizer.tools.evaluation.comparison import (
        Answer,
        Recording,
        Result,
        compare,
        load_recording,
        table,
    )
    from rs_localizer.tools.simulation.frames import frame_stamps, simulate_frames
    from rs_localizer.tools.simulation.recording import write_simulated, write_truth
    from rs_localizer.tools.simulation.scene import room
    from rs_localizer.tools.simulation.true_motion import RecordedMotion

# The part of the hand's motion that is flown (s): it begins slowly and ends in quick turns.
_FLIGHT_START, _FLIGHT_DURATION = 8.0, 18.0
_CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
_QUICK_FRAMES = 12
_SEEN = FrameSettings()
CUBE = "cube.gif"
# What the first run on a machine takes: s of the machine on which a loop of _LOOP takes _LOOP_TIME.
_FIRST, _EACH, _LOOP, _LOOP_TIME = 150.0, 40.0, 1_000_000, 0.05
# s between two lines that say how far it is, where no terminal shows a bar.
_PERIOD = 15.0

_AFTERWARDS = """
Your own camera, next:
  rs_localizer markers make board --help            print a board
  rs_localizer calibrate video.mp4 --board 9x6 --square 0.025 --out shutter.yaml
  localizer --ros-args --params-file shutter.yaml   the node (docs/node.md)
"""


_SOLVER = NodeConfig().solver


@dataclass(frozen=True, kw_only=True)
class Options:
    out: Path = option("for the pictures", "DIR", Path("out"))
    quick: bool = option("a few frames of each recording only", default=False)


class Act(NamedTuple):
    """One recording, and what was found of it by each method, the rolling shutter's first."""

    recording: Recording
    readout_time: float
    results: dict[str, Result]


def run(options: Options) -> None:
    started = time.monotonic()
    options.out.mkdir(parents=True, exist_ok=True)
    methods = {_SOLVER: _SOLVER, "p3p (one pose per image)": "p3p"}
    most = _QUICK_FRAMES if options.quick else None
    print(
        f"{_minutes(_FIRST)} at the first time on this machine, {_minutes(_EACH)} later; 0.5 GB of "
        f"memory, 40 MB of disk for compiled code in {cache_directory()}, 5 MB in {options.out}. "
        "If it is stopped, the same command goes on with what has been compiled.",
        flush=True,
    )
    with tempfile.TemporaryDirectory() as directory, compiler.told(_compiling()):
        place = Path(directory)
        flight = _act(_fly(place, most), _CAMERA.readout_time, methods, "Simulated flight")
        _draw(options.out, **_of_flight(flight))
        webcam = load_recording(data.path(data.WEBCAM), most)
        shown = build(load_params_file(data.path(data.WEBCAM) / "parameters.yaml"))
        board = _act(webcam, shown.readout_time, methods, "Webcam over a board")
        residuals = plots.residual_picture(webcam, board.results, board.readout_time)
        _draw(options.out, webcam_residuals=residuals)
        _cube(place, most, methods, options.out / CUBE)
        _live(flight, _SOLVER, place)
    print(f"done in {time.monotonic() - started:.0f} s\n{_AFTERWARDS}", end="")


def _minutes(seconds: float) -> str:
    """How long work takes on this machine, as busy as it is, by a short loop."""
    began = time.monotonic()
    for _ in range(_LOOP):
        pass
    speed = (time.monotonic() - began) / _LOOP_TIME
    return f"about {max(1, round(speed * seconds / 60.0))} min"


def _compiling() -> Callable[[int, str], None]:
    """Says which kernel is compiled: on a terminal in one line, elsewhere now and then."""
    last = -_PERIOD

    def tell(count: int, name: str) -> None:
        nonlocal last
        if sys.stderr.isatty():
            print(f"\r\033[Kcompiling {count}: {name}\r", end="", file=sys.stderr, flush=True)
        elif time.monotonic() - last > _PERIOD:
            last = time.monotonic()
            print(f"compiling {count}: {name}", flush=True)

    return tell


@contextmanager
def _stage(name: str, total: int) -> Iterator[Callable[[], object]]:
    """A bar on a terminal, elsewhere lines; what moves it on."""
    if sys.stderr.isatty():
        with stage(name, total) as step:
            yield lambda: step(1)
        return
    print(name, flush=True)
    done, last = 0, time.monotonic()

    def step_on() -> None:
        nonlocal done, last
        done += 1
        if time.monotonic() - last > _PERIOD:
            last = time.monotonic()
            print(f"{name}: {done} of {total}", flush=True)

    yield step_on


def _act(recording: Recording, readout_time: float, methods: Mapping[str, str], title: str) -> Act:
    """Localize all frames by all methods, and print what came of it."""
    results = {}
    for name, solver in methods.items():
        with _stage(f"{title}, {solver}", len(recording.clouds)) as step:
            answers = _localized(recording, _settings(solver, readout_time), step)
        results[name] = compare(answers, recording.truth)
    print(f"\n{table(title, recording, results)}\n", flush=True)
    return Act(recording, readout_time, results)


def _settings(solver: str, readout_time: float) -> dict[str, Any]:
    return {"solver": solver, "readout_time": readout_time, "pose_time": "mid_frame"}


def _localized(
    recording: Recording, settings: Mapping[str, Any], step: Callable[[], object]
) -> dict[int, Answer]:
    """The answers by the stamp of the frame, as those of a node with these settings."""
    localizer, answers = FrameLocalizer(build(settings)), {}
    localizer.warm_up()
    for stamp, info, cloud in zip(
        recording.stamps_ns, recording.camera_infos, recording.clouds, strict=True
    ):
        localizer.calibrate(read_camera_info(info))
        began = time.perf_counter()
        frame = localizer.localize(cloud)
        latency = time.perf_counter() - began
        step()
        if frame:
            twist = frame.twist
            answers[stamp] = Answer(
                stamp, latency, frame.stamp_ns, frame.pose.position,
                Rotation.from_matrix(frame.pose.rotation).as_quat(),
                None if twist is None else twist.angular,
                None if twist is None else twist.linear,
                frame.inliers["residual"].astype(np.float64),
            )  # fmt: skip
    return answers


def _fly(directory: Path, most: int | None) -> Recording:
    motion = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    start_ns = motion.intervals_ns[0][0] + round(_FLIGHT_START * 1e9)
    end_ns = start_ns + round(_FLIGHT_DURATION * 1e9)
    all_stamps = frame_stamps(motion, _CAMERA, _SEEN.rate)
    stamps = [stamp for stamp in all_stamps if start_ns <= stamp < end_ns][:most]
    path = motion.state(start_ns, np.linspace(0.0, _FLIGHT_DURATION, 200)).positions
    scene = room(path, np.random.default_rng(0))
    with (
        BagWriter(directory / "flight") as bag,
        _stage("Simulating a flight along a hand's motion", len(stamps)) as step,
    ):
        for frame in simulate_frames(_CAMERA, motion, scene, _SEEN, stamps_ns=stamps):
            write_simulated(bag, _CAMERA, frame)
            step()
    return load_recording(directory / "flight")


def _of_flight(flight: Act) -> dict[str, Any]:
    recording, results = flight.recording, flight.results
    true_matches = np.array([(1.0 - _SEEN.outliers) * cloud.width for cloud in recording.clouds])
    return {
        "flight_inliers": plots.inlier_picture(recording, results, true_matches),
        "flight_trajectories": plots.trajectory_picture(recording, results),
        "flight_errors": plots.error_picture(results),
    }


def _draw(out: Path, **figures: Any) -> None:
    for name, figure in figures.items():
        if figure is not None:
            plots.save(figure, out / f"{name}.png")
            print(out / f"{name}.png", flush=True)


def _cube(directory: Path, most: int | None, methods: Mapping[str, str], out: Path) -> None:
    """Walls of markers, rendered and detected, and the cube there by the poses of both methods."""
    walls = cube_clip.MarkerWalls(read_tum(data.path(data.HAND_MOTION)), 0, cube_clip.CLIP_SENSOR)
    stamps, now = cube_clip.clip_stamps(walls, most), np.zeros(1)
    camera, images, middles = cube_clip.CAMERA, list[Image](), list[int]()
    with (
        BagWriter(directory / "cube") as bag,
        _stage("Rendering walls of markers", len(stamps)) as step,
    ):
        for frame, image in walls.frames(stamps):
            images.append(image)
            middles.append(frame.middle_ns)
            ids = np.arange(len(frame.points))
            write_frame(bag, camera, frame.stamp_ns, frame.points, frame.pixels, ids)
            for moment in (frame.stamp_ns, frame.middle_ns):
                write_truth(bag, moment, walls.motion.state(moment, now))
            step()
    recording = load_recording(directory / "cube")
    results = list(
        _act(recording, camera.readout_time, methods, "Walls of markers").results.values()
    )

    def motion(result: Result, stamp: int) -> Motion | None:
        answer = result.answers.get(stamp)
        return None if answer is None else answer.motion(camera.readout_time)

    shown = slice(cube_clip.RUN_UP, None)
    ours, p3p = cube_clip.OURS, cube_clip.P3P
    motions = [
        {p3p: motion(results[1], stamp), ours: motion(results[0], stamp)} for stamp in stamps[shown]
    ]
    clip = cube_clip.draw_clip(walls, middles[shown], images[shown], motions)
    out.write_bytes(clip.animation)
    medians = {name: np.median(errors) for name, errors in clip.errors.items()}
    print(
        f"The cube's farthest corner is off by {medians[ours]:.2f} px in the median, by "
        f"{medians[p3p]:.1f} px with P3P.\n{out}",
        flush=True,
    )


def _live(flight: Act, solver: str, directory: Path) -> None:
    """The flight once more through a live node, which says the same."""
    try:
        live = import_ros("live", "a live node")
    except ValueError as error:
        print(f"left out: {error}")
        return
    recording, readout_time = flight.recording, flight.readout_time
    settings, delay_ns = _settings(solver, readout_time), round(0.5e9 * readout_time)
    answers = next(iter(flight.results.values())).answers
    known, same, late = 0, 0, list[float]()
    print("Starting a live node", flush=True)
    try:
        with live.LiveNode(settings, directory / "node.log", delay_ns) as node:
            node.wait(lambda line: print(f"  {line}", flush=True))
            with _stage("The flight through a live node", len(recording.clouds)) as step:
                for stamp, info, cloud in zip(
                    recording.stamps_ns, recording.camera_infos, recording.clouds, strict=True
                ):
                    began = time.perf_counter()
                    pose = node.localize(info, cloud)
                    step()
                    if pose is None or stamp not in answers:
                        same += pose is None and stamp not in answers
                        continue
                    late.append(time.perf_counter() - began)
                    known += 1
                    position = pose.pose.position
                    there = position.x, position.y, position.z
                    same += tuple(answers[stamp].position.tolist()) == there
    except live.LiveError as error:
        again = shlex.join(["rs_localizer", *sys.argv[1:]])
        print(error)
        raise ValueError(f"no live node; tables and pictures are there; again: {again}") from error
    p50, p95 = np.percentile(1e3 * np.array(late or [np.nan]), [50, 95])
    print(
        f"The live node has answered {known} of {len(recording.clouds)} frames, {same} as above to "
        f"the last bit; {p50:.1f} ms from message to pose, 95 % within {p95:.1f} ms"
    )
