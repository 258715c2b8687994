"""``rs_localizer demo``: the bundled recordings through live nodes; a table and pictures."""

from __future__ import annotations

import argparse
import importlib
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.figure import Figure
from tqdm import tqdm

from rs_localizer import data
from rs_localizer.cli.demo_cube import CUBE, CubeScene
from rs_localizer.cli.demo_room import play_room
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.evaluation import plots
from rs_localizer.evaluation.comparison import Recording, Result, compare, load_recording, table
from rs_localizer.evaluation.plots import (
    error_picture,
    inlier_picture,
    residual_picture,
    trajectory_picture,
)
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.trajectories import read_tum
from rs_localizer.settings import build, load_params_file
from rs_localizer.simulation.frames import FrameSettings, frame_stamps, simulate_frames
from rs_localizer.simulation.recording import write_simulated
from rs_localizer.simulation.scene import room
from rs_localizer.simulation.true_motion import RecordedMotion
from rs_localizer.solvers.table import SOLVERS

_GLOBAL, _ROLLING = "global_shutter", "rolling_shutter"
# The part of the hand's motion that is flown (s): it begins slowly and ends in quick turns.
_FLIGHT_START, _FLIGHT_DURATION = 8.0, 18.0
_FLIGHT_CAMERA = Camera(
    640, 480, np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
_QUICK_FRAMES = 12
_SEEN = FrameSettings()


class Act(NamedTuple):
    """One recording, and what the nodes answered."""

    recording: Recording
    readout_time: float
    results: dict[str, Result]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--out", type=Path, default=Path("out"), metavar="DIR", help="for the pictures"
    )
    parser.add_argument(
        "--solver",
        choices=[name for name, row in SOLVERS.items() if row.rolling_shutter],
        default=NodeConfig().solver,
        help="solver that is compared with p3p (default: %(default)s)",
    )
    parser.add_argument("--quick", action="store_true", help="a few frames of each recording only")


def run(args: argparse.Namespace) -> None:
    try:
        session_type = importlib.import_module("rs_localizer.ros.graph.demo_session").Session
    except ImportError as error:
        raise ValueError(
            f"the demo needs ROS 2 ({error}): source a ROS 2 workspace, or install rclpy with pip "
            "(docs/install.md)"
        ) from error
    started = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    methods = {_ROLLING: {"solver": args.solver}, _GLOBAL: {"solver": "p3p"}}
    names = {_ROLLING: args.solver, _GLOBAL: "p3p (one pose per image)"}
    with tempfile.TemporaryDirectory() as directory, session_type(Path(directory)) as session:
        print(f"two live nodes below {session.namespace}: solver {args.solver} and solver p3p")
        most = _QUICK_FRAMES if args.quick else None
        print("starting them; the first time on a machine, this compiles the solvers", flush=True)
        webcam = load_recording(data.path(data.WEBCAM), most)
        flight = load_recording(_fly(Path(directory), most))
        scene = CubeScene()
        cube = load_recording(scene.record(Path(directory) / "cube", most))
        acts = []
        for title, recording, readout_time in (
            ("Webcam over a board", webcam, _webcam_readout_time()),
            ("Simulated hand-held flight", flight, _FLIGHT_CAMERA.readout_time),
            ("Rendered walls of markers", cube, scene.readout_time),
        ):
            total = len(recording.clouds)
            with tqdm(total=total, unit="frame", desc=title, disable=None) as bar:
                answers = session.play(
                    recording, readout_time, methods, bar.update, lossless=(_ROLLING,)
                )
            results = {names[name]: compare(answers[name], recording.truth) for name in methods}
            acts.append(Act(recording, readout_time, results))
            print(f"\n{table(title, recording, results)}", flush=True)
        if not args.quick:
            play_room(session, methods, names, args.out, Path(directory))
        by_us, by_p3p = names[_ROLLING], names[_GLOBAL]
        print(scene.draw(cube, acts[2].results, by_us, by_p3p, args.out / CUBE))
        print(f"\n{args.out / CUBE}")
        for name, figure in _pictures(*acts[:2]).items():
            if figure is not None:
                plots.save(figure, args.out / name)
                print(args.out / name)
    print(f"done in {time.monotonic() - started:.0f} s")


def _webcam_readout_time() -> float:
    return build(load_params_file(data.path(data.WEBCAM) / "parameters.yaml")).readout_time


def _fly(directory: Path, most: int | None) -> Path:
    """Simulate the flight into a bag."""
    motion = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    start_ns = motion.intervals_ns[0][0] + round(_FLIGHT_START * 1e9)
    end_ns = start_ns + round(_FLIGHT_DURATION * 1e9)
    stamps = [
        stamp
        for stamp in frame_stamps(motion, _FLIGHT_CAMERA, _SEEN.rate)
        if start_ns <= stamp < end_ns
    ][:most]
    way = motion.state(start_ns, np.linspace(0.0, _FLIGHT_DURATION, 200)).positions
    frames = simulate_frames(
        _FLIGHT_CAMERA, motion, room(way, np.random.default_rng(0)), _SEEN, stamps_ns=stamps
    )
    with BagWriter(directory / "flight") as bag:
        bar = tqdm(frames, "Simulating a flight", len(stamps), unit="frame", disable=None)
        for frame in bar:
            write_simulated(bag, _FLIGHT_CAMERA, frame)
    return directory / "flight"


def _pictures(webcam: Act, flight: Act) -> dict[str, Figure | None]:
    """Figures by file name; None where there is nothing to show."""
    recording, results = flight.recording, flight.results
    true_matches = np.array([(1.0 - _SEEN.outliers) * cloud.width for cloud in recording.clouds])
    return {
        "flight_trajectories.png": trajectory_picture(recording, results),
        "flight_errors.png": error_picture(results),
        "flight_inliers.png": inlier_picture(recording, results, true_matches),
        "webcam_residuals.png": residual_picture(
            webcam.recording, webcam.results, webcam.readout_time
        ),
    }
