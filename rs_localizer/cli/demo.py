# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer demo``: the bundled recordings through live nodes; a table and pictures."""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from rs_localizer.cli import WORKING, import_ros, stage
from rs_localizer.config import NodeConfig
from rs_localizer.core.camera import Camera
from rs_localizer.simulation.settings import FrameSettings, ImageSettings
from rs_localizer.solvers.table import SOLVERS

if WORKING:
    from matplotlib.figure import Figure
    from scipy.spatial.transform import Rotation
    from tqdm import tqdm

    from rs_localizer import data
    from rs_localizer.core.shutter import Motion
    from rs_localizer.evaluation import plots
    from rs_localizer.evaluation.comparison import Recording, Result, compare, load_recording, table
    from rs_localizer.evaluation.cube_clip import (
        CAMERA,
        CLIP_SENSOR,
        OURS,
        P3P,
        RUN_UP,
        MarkerWalls,
        clip_stamps,
        draw_clip,
    )
    from rs_localizer.io.bags import BagWriter
    from rs_localizer.io.maps.files import write_npz
    from rs_localizer.io.recording import make_camera_info, write_frame
    from rs_localizer.io.topics import KEYPOINTS
    from rs_localizer.io.trajectories import Motions, Trajectory, Twists, read_tum
    from rs_localizer.io.video import Image
    from rs_localizer.process.missing import explain
    from rs_localizer.settings import build, load_params_file
    from rs_localizer.simulation.frames import frame_stamps, middle_stamp, simulate_frames
    from rs_localizer.simulation.recording import write_simulated, write_truth
    from rs_localizer.simulation.scene import room
    from rs_localizer.simulation.true_motion import RecordedMotion
    from rs_localizer.tools.mapping.colmap import Effort, require
    from rs_localizer.tools.mapping.pictures import localized_picture
    from rs_localizer.tools.room_mapping import Piece, Room, without_refinement

    _WALK, _FLIGHT = Piece(28.0, 11.8, 15.0), Piece(40.0, 8.0, 10.0)  # of the room
    _EFFORT = Effort(adjusted=60)

ROOM = "room.png"
# A quarter of VGA: all of it within half a minute.
_CAMERA = Camera(
    320, 240, np.array([[250.0, 0.0, 159.5], [0.0, 250.0, 119.5], [0.0, 0.0, 1.0]]),
    readout_time=0.03,
)  # fmt: skip
_SENSOR = ImageSettings(noise=2.0)
_KEYPOINTS = 300


def _second_walk(room: Room) -> Recording:
    """The keypoints that it sees, and the truth at the middle rows."""
    stamps = room.stamps(_FLIGHT)
    with stage("Walking there again", len(stamps)) as step:
        clouds = room.clouds(_FLIGHT, lambda: step(1))
    middles = np.array([middle_stamp(_CAMERA, stamp) for stamp in stamps], np.int64)
    states = [room.motion.state(int(middle), np.zeros(1)) for middle in middles]
    rotations, positions, angular, linear = (
        np.concatenate([getattr(state, name) for state in states])
        for name in ("rotations", "positions", "angular", "linear")
    )
    turns = Rotation.from_matrix(rotations).as_quat()
    truth = Motions(Trajectory(middles, positions, turns), Twists(middles, angular, linear))
    infos = [make_camera_info(_CAMERA, stamp) for stamp in stamps]
    return Recording(stamps, infos, clouds, {}, truth)


def _play_room(
    session: Any,
    methods: Mapping[str, Mapping[str, Any]],
    names: Mapping[str, str],
    out: Path,
    directory: Path,
) -> None:
    """Let the nodes of several methods localize a second walk; print and draw what they said.

    Args:
        session: of the live nodes.
        methods: their settings, by name: the rolling shutter's first, then the global one's.
        names: what they are called in tables.
        out: for the picture.
        directory: for what is passing.
    """
    try:
        require()
    except ImportError as error:
        print(f"\nA room without markers is left out: {explain(error)}")
        return
    room = Room(read_tum(data.path(data.HAND_MOTION)), _CAMERA, _SENSOR, _KEYPOINTS)
    folder = directory / "colmap"
    folder.mkdir()
    with TemporaryDirectory() as images:
        with stage("Walking through a room", len(room.stamps(_WALK))) as step:
            views = room.look(_WALK, Path(images), lambda: step(1))
        built = room.build(views, folder, stage, _EFFORT)
    maps, with_maps = (built.landmarks, without_refinement(built)), {}
    for (name, settings), landmarks in zip(methods.items(), maps, strict=True):
        file = directory / f"{name}.npz"
        write_npz(file, landmarks)
        with_maps[name] = {**settings, "map_file": str(file)}
    recording = _second_walk(room)
    with tqdm(
        total=len(recording.clouds), unit="frame", desc="Room without markers", disable=None
    ) as bar:
        answers = session.play(
            recording, _CAMERA.readout_time, with_maps, bar.update,
            lossless=(next(iter(methods)),), topic=KEYPOINTS,
        )  # fmt: skip
    results = {names[name]: compare(answers[name], recording.truth) for name in methods}
    print(f"\n{table('A room mapped without markers', recording, results)}", flush=True)
    assert recording.truth is not None
    poses = {name: result.poses for name, result in results.items()}
    picture = localized_picture(built.landmarks.points, recording.truth.poses, poses)
    plots.save(picture, out / ROOM)
    print(out / ROOM)


CUBE = "cube.gif"


class CubeScene:
    """Rendered images of marker walls, the correspondences in them, and the cube."""

    def __init__(self) -> None:
        self._walls = MarkerWalls(read_tum(data.path(data.HAND_MOTION)), 0, CLIP_SENSOR)
        self._images: dict[int, Image] = {}
        self._middles: dict[int, int] = {}

    def record(self, path: Path, most: int | None) -> Path:
        """Render the clip, find the markers, and write them into a bag."""
        stamps = clip_stamps(self._walls, most)
        now = np.zeros(1)
        with BagWriter(path) as bag:
            frames = self._walls.frames(stamps)
            bar = tqdm(frames, "Rendering a cube's room", len(stamps), unit="frame", disable=None)
            for frame, image in bar:
                stamp, middle = frame.stamp_ns, frame.middle_ns
                self._images[stamp], self._middles[stamp] = image, middle
                ids = np.arange(len(frame.points))
                write_frame(bag, CAMERA, stamp, frame.points, frame.pixels, ids)
                for moment in (stamp, middle):
                    write_truth(bag, moment, self._walls.motion.state(moment, now))
        return path

    def draw(
        self, recording: Recording, results: Mapping[str, Result], ours: str, p3p: str, out: Path
    ) -> str:
        """Write the animated picture; a sentence on where the cube is."""
        stamps = recording.stamps_ns[RUN_UP:]

        def motion(name: str, stamp: int) -> Motion | None:
            answer = results[name].answers.get(stamp)
            return None if answer is None else answer.motion(CAMERA.readout_time)

        motions = [{P3P: motion(p3p, stamp), OURS: motion(ours, stamp)} for stamp in stamps]
        clip = draw_clip(
            self._walls,
            [self._middles[stamp] for stamp in stamps],
            [self._images[stamp] for stamp in stamps],
            motions,
        )
        out.write_bytes(clip.animation)
        medians = {name: np.median(errors) for name, errors in clip.errors.items()}
        return (
            f"The cube's farthest corner is off by {medians[OURS]:.2f} px in the median, "
            f"by {medians[P3P]:.1f} px with P3P."
        )


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
    session_type = import_ros("demo_session", "the demo").Session
    started = time.monotonic()
    args.out.mkdir(parents=True, exist_ok=True)
    methods = {_ROLLING: {"solver": args.solver}, _GLOBAL: {"solver": "p3p"}}
    names = {_ROLLING: args.solver, _GLOBAL: "p3p (one pose per image)"}
    with tempfile.TemporaryDirectory() as directory, session_type(Path(directory)) as session:
        print(f"two live nodes below {session.namespace}: solver {args.solver} and solver p3p")
        most = _QUICK_FRAMES if args.quick else None
        print("starting them; the first time on a machine, this compiles the solvers", flush=True)
        webcam = load_recording(data.path(data.WEBCAM), most)
        shown = build(load_params_file(data.path(data.WEBCAM) / "parameters.yaml"))
        flight = load_recording(_fly(Path(directory), most))
        scene = CubeScene()
        cube = load_recording(scene.record(Path(directory) / "cube", most))
        acts = []
        for title, recording, readout_time in (
            ("Webcam over a board", webcam, shown.readout_time),
            ("Simulated hand-held flight", flight, _FLIGHT_CAMERA.readout_time),
            ("Rendered walls of markers", cube, CAMERA.readout_time),
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
            _play_room(session, methods, names, args.out, Path(directory))
        by_us, by_p3p = names[_ROLLING], names[_GLOBAL]
        print(scene.draw(cube, acts[2].results, by_us, by_p3p, args.out / CUBE))
        print(f"\n{args.out / CUBE}")
        for name, figure in _pictures(*acts[:2]).items():
            if figure is not None:
                plots.save(figure, args.out / name)
                print(args.out / name)
    print(f"done in {time.monotonic() - started:.0f} s")


def _fly(directory: Path, most: int | None) -> Path:
    motion = RecordedMotion(read_tum(data.path(data.HAND_MOTION)))
    start_ns = motion.intervals_ns[0][0] + round(_FLIGHT_START * 1e9)
    end_ns = start_ns + round(_FLIGHT_DURATION * 1e9)
    stamps = [
        stamp
        for stamp in frame_stamps(motion, _FLIGHT_CAMERA, _SEEN.rate)
        if start_ns <= stamp < end_ns
    ][:most]
    path = motion.state(start_ns, np.linspace(0.0, _FLIGHT_DURATION, 200)).positions
    frames = simulate_frames(
        _FLIGHT_CAMERA, motion, room(path, np.random.default_rng(0)), _SEEN, stamps_ns=stamps
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
        "flight_trajectories.png": plots.trajectory_picture(recording, results),
        "flight_errors.png": plots.error_picture(results),
        "flight_inliers.png": plots.inlier_picture(recording, results, true_matches),
        "webcam_residuals.png": plots.residual_picture(
            webcam.recording, webcam.results, webcam.readout_time
        ),
    }
