# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer simulate``: a bag with ground truth of rolling-shutter cameras, and an IMU."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from rs_localizer import data
from rs_localizer.cli import earlier_result, typed
from rs_localizer.cli.options import ResultOptions, UsageError, argument, option
from rs_localizer.core.arrays import Array
from rs_localizer.core.camera import Camera
from rs_localizer.core.scanning import ScanDirection
from rs_localizer.io.atomic_files import atomic_directory
from rs_localizer.io.bags import BagWriter
from rs_localizer.io.camera_files import pinhole_matrix, read_calibration
from rs_localizer.io.maps.files import write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import MAP, MAP_FRAME, MARKER_MAP, PARAMETERS
from rs_localizer.io.rigs import node_parameters, read_camchain
from rs_localizer.io.topics import TF_STATIC
from rs_localizer.io.trajectories import read_tum
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.settings import build, camera_values, settings, write_parameters
from rs_localizer.tools.simulation.renderer import (
    ImageSettings,
    RenderedFrame,
    Renderer,
    rendered_frames,
)
from rs_localizer.tools.simulation.scene import room
from rs_localizer.tools.simulation.simulated_frames import (
    FrameSettings,
    SimulatedFrame,
    frame_stamps,
    middle_stamp,
    simulate_frames,
)
from rs_localizer.tools.simulation.simulated_imu import (
    ImuSettings,
    Lever,
    shaken,
    simulate_imu,
    write_imu,
)
from rs_localizer.tools.simulation.simulated_recording import (
    RIG_FRAME,
    camera_stamps,
    keypoint_rows,
    make_mounts,
    random_descriptors,
    simulate_rig,
    write_rig_frame,
    write_simulated,
)
from rs_localizer.tools.simulation.true_motion import (
    ConstantVelocity,
    RecordedMotion,
    TrueMotion,
    sampled_states,
)
from rs_localizer.tools.simulation.walls import SCENES, Scene

# A still hand is no example: without any motion given, the camera turns and walks like this.
_ANGULAR_VELOCITY, _LINEAR_VELOCITY = (0.0, 1.0, 0.0), (0.3, 0.0, 0.0)
_DURATION = 10.0
_START_NS = 1_000_000_000  # a time of 0 means "none" to ROS
BUNDLED = "tum_vi_room5"  # stands for the bundled trajectory
_READOUT_TIME = 0.03  # s, of a webcam
_POINTS, _PICTURES = FrameSettings(), ImageSettings()
# Options of the one kind of recording that mean nothing to the other.
_OF_POINTS, _OF_IMAGES = ("points", "outliers", "keypoints"), ("walls", "exposure")
_OF_A_CAMERA = {"camera", "readout_time", "scan_direction", "imu", "imu_offset"}
# Random numbers of their own: the frames are the same with and without them.
_IMU_STREAM, _VIBRATION_STREAM = 14, 60


@dataclass(frozen=True, kw_only=True)
class MotionOptions:
    """motion."""

    trajectory: Path | None = option(
        "follow recorded poses: TUM text, also .gz; gaps are left out, never bridged "
        f"({BUNDLED}: the bundled motion of a hand-held rig)", "FILE",
    )  # fmt: skip
    angular_velocity: tuple[float, float, float] | None = option(
        "rad/s in camera axes (x right, y down, z forward); without any motion given: 0 1 0",
        "X Y Z",
    )
    linear_velocity: tuple[float, float, float] | None = option(
        "m/s along the camera axes at the start; without any motion given: 0.3 0 0", "X Y Z"
    )
    start: float = option("seconds to skip", "S", 0.0, least=0.0)
    duration: float | None = option(
        f"seconds (default: the whole trajectory; {_DURATION:g} at constant velocity)", "S",
        above=0.0,
    )  # fmt: skip
    vibration: list[tuple[float, float]] = option(
        "add vibration by DEG about any axis; may be repeated", "DEG HZ",
        list, least=0.0,
    )  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class CameraOptions:
    """camera."""

    camera: Path | None = option(
        "lens and shutter, as calibrate writes it; or a calibration (default: 640x480, 500 px)",
        "FILE",
    )  # fmt: skip
    readout_time: float | None = option(
        f"from the first row to the last (default: that of the camera, or {_READOUT_TIME:g})", "S",
        least=0.0, most=settings()["readout_time"].maximum or 0.0,
    )  # fmt: skip
    scan_direction: str | None = option(
        "of the shutter (default: that of the camera, or top_to_bottom)",
        choices=[direction.value for direction in ScanDirection],
    )  # fmt: skip
    rig: Path | None = option(
        "several cameras instead: Kalibr's camchain, with readout_time and scan_direction of each",
        "FILE",
    )  # fmt: skip
    imu: bool = option("write an IMU, too, and its mounting on /tf_static", default=False)
    imu_offset: float = option("to add to its stamps to get the camera's time", "S", 0.0)


@dataclass(frozen=True, kw_only=True)
class Options(MotionOptions, CameraOptions, ResultOptions):
    out: Path = argument("bag directory to create", "OUT")
    points: int = option("points of a frame, if it sees that many", "N", _POINTS.points, least=1)
    noise: float | None = option(
        f"deviation: px of each raw coordinate (default: {_POINTS.noise:g}); of images, grey "
        f"levels of 255 ({_PICTURES.noise:g})", "SIGMA", least=0.0,
    )  # fmt: skip
    outliers: float = option("of the points", "SHARE", _POINTS.outliers, least=0.0, most=1.0)
    keypoints: bool = option(
        "pixels with binary descriptors, and their map, instead of matches", default=False
    )
    images: bool = option("render camera images, instead of points", default=False)
    walls: str = option(
        "of images; three: walls of markers at right angles, with their map; room: generated "
        "pictures",
        default=next(iter(SCENES)), choices=list(SCENES),
    )  # fmt: skip
    exposure: float = option("of a row: motion blur of images", "S", _PICTURES.exposure, least=0.0)
    seed: int = option("of all random numbers", "N", 0, least=0)


def _camera(args: Options) -> Camera:
    """Return the camera of ``--camera``, or a webcam, with the shutter of the options."""
    lens = Camera(640, 480, pinhole_matrix(500.0, 500.0, 319.5, 239.5), readout_time=_READOUT_TIME)
    values = dict[str, Any]()
    if args.camera is not None:
        lens, values = read_calibration(args.camera), camera_values(args.camera)
    given = {"readout_time": args.readout_time, "scan_direction": args.scan_direction}
    values |= {name: value for name, value in given.items() if value is not None}
    config = build({"readout_time": lens.readout_time or _READOUT_TIME} | values)
    return replace(lens, readout_time=config.readout_time, scan_direction=config.scan_direction)


def _smooth_motion(args: Options) -> TrueMotion:
    """Return the recorded motion, or one at constant velocity."""
    angular, linear = args.angular_velocity, args.linear_velocity
    if args.trajectory is not None:
        if (angular, linear) != (None, None):
            raise UsageError("give either --trajectory or velocities, not both")
        bundled = args.trajectory == Path(BUNDLED) and not args.trajectory.exists()
        return RecordedMotion(read_tum(data.path(data.HAND_MOTION) if bundled else args.trajectory))
    if angular is None and linear is None:
        angular, linear = _ANGULAR_VELOCITY, _LINEAR_VELOCITY
    rest, duration = (0.0, 0.0, 0.0), _DURATION if args.duration is None else args.duration
    velocities = np.array(angular or rest), np.array(linear or rest)
    return ConstantVelocity(*velocities, args.start + duration, start_ns=_START_NS)


def _world(args: Options, motion: TrueMotion, rng: np.random.Generator) -> Scene | Array:
    """Return surroundings of a motion: a scene to be rendered, or the points (n,3) of a room."""
    if args.images:
        return SCENES[args.walls](sampled_states(motion))
    times = ((first, np.linspace(0.0, (end - first) * 1e-9, 200)) for first, end in
             motion.intervals_ns)  # fmt: skip
    return room(np.concatenate([motion.state(*each).positions for each in times]), rng)


def _see(
    args: Options, world: Scene | Array, camera: Camera, motion: TrueMotion, stamps: list[int],
    place: int = 0,
) -> Iterator[SimulatedFrame | RenderedFrame]:  # fmt: skip
    """Return the frames that a camera sees; ``place`` is its own among the random numbers."""
    seed = args.seed + place
    usual = _PICTURES if isinstance(world, Scene) else _POINTS
    noise = usual.noise if args.noise is None else args.noise
    if isinstance(world, Scene):
        renderer = Renderer(camera, world.planes, ImageSettings(args.exposure, noise))
        return rendered_frames(renderer, motion, stamps, seed)
    seen = FrameSettings(args.points, noise, args.outliers)
    return simulate_frames(camera, motion, world, seen, stamps_ns=stamps, seed=seed)


def run(args: Options) -> dict[str, object]:
    given = {item.name for item in fields(args) if getattr(args, item.name) != item.default}
    for name in given & {*(_OF_POINTS if args.images else _OF_IMAGES)}:
        raise UsageError(f"--{name} is {'not ' if args.images else ''}for --images")
    for name in given & _OF_A_CAMERA if args.rig is not None else ():
        raise UsageError(f"--rig goes without --{name.replace('_', '-')}")
    if "imu_offset" in given and not args.imu:
        raise UsageError("--imu-offset goes with --imu")
    recorder = _Recorder(args)
    with atomic_directory(args.out, earlier_result(args, "metadata.yaml")) as built:
        recorder.write(built)
    return recorder.print_result()


class _Recorder:
    """Writes the views of cameras in a world."""

    def __init__(self, args: Options) -> None:
        vibrating = np.random.default_rng([args.seed, _VIBRATION_STREAM])
        self._args = args
        self._motion = shaken(_smooth_motion(args), args.vibration, vibrating)
        self._parts = None if args.rig is None else read_camchain(args.rig)
        cameras = [_camera(args)] if self._parts is None else [*self._parts.cameras.values()]
        self._camera = cameras[0]
        start_ns = self._motion.intervals_ns[0][0] + round(args.start * 1e9)
        end_ns = math.inf if args.duration is None else start_ns + round(args.duration * 1e9)
        every = frame_stamps(self._motion, self._camera, _POINTS.rate)
        self.stamps = [stamp for stamp in every if start_ns <= stamp < end_ns]
        if not self.stamps:
            raise ValueError("no frame lies within the motion, --start and --duration")
        self._rng = np.random.default_rng(args.seed)
        self.world = _world(args, self._motion, self._rng)
        self.counts = list[int]()  # points of the frames
        self._map: Map | None = None
        if args.keypoints and not isinstance(self.world, Scene):
            ids, marks = np.arange(len(self.world)), random_descriptors(len(self.world), self._rng)
            self._map = Map(self.world, ids, marks, MAP_FRAME)

    def write(self, folder: Path) -> None:
        """Write the bag, and beside it the parameters of the cameras and what they see."""
        parameters = self._write_camera(folder) if self._parts is None else self._write_rig(folder)
        if self.counts and not any(self.counts):
            raise ValueError(
                f"none of the {len(self.counts)} images sees any point; nothing is written to "
                f"{self._args.out}"
            )
        write_parameters(folder / PARAMETERS, parameters)
        if isinstance(self.world, Scene) and self.world.marker_map is not None:
            write_marker_map(folder / MARKER_MAP, self.world.marker_map)
        if self._map is not None:
            write_npz(folder / MAP, self._map)

    def _keypoints(self, frame: SimulatedFrame | RenderedFrame) -> NDArray[Any] | None:
        """Count a frame's points; its keypoints, if they are wanted."""
        if not isinstance(frame, SimulatedFrame):
            return None
        self.counts.append(len(frame.points))
        return None if self._map is None else keypoint_rows(frame, self._map, self._rng)

    def _write_camera(self, folder: Path) -> dict[str, Any]:
        args, camera, stamps = self._args, self._camera, self.stamps
        # As from a real camera: recorded when the last row has been read.
        later_ns = round(camera.readout_time * 1e9) if args.imu else 0
        with BagWriter(folder) as bag:
            if args.imu:
                lever, imu = Lever(), ImuSettings(time_offset=args.imu_offset)
                rng = np.random.default_rng([args.seed, _IMU_STREAM])
                track = simulate_imu(self._motion, imu, lever, rng)
                last_ns = middle_stamp(camera, stamps[-1]) + later_ns
                write_imu(bag, track, imu, lever, stamps[0], last_ns)
            frames = _see(args, self.world, camera, self._motion, stamps)
            for frame in tqdm(frames, "simulate", len(stamps), unit="frame", disable=None):
                write_simulated(bag, camera, frame, self._keypoints(frame), later_ns)
        direction = str(camera.scan_direction)
        return {"readout_time": camera.readout_time, "scan_direction": direction}

    def _write_rig(self, folder: Path) -> dict[str, Any]:
        parts, motion = self._parts, self._motion
        assert parts is not None
        first, last = self.stamps[0], self.stamps[-1]
        every = camera_stamps(parts, motion, _POINTS.rate, self._args.seed)
        stamps = {name: [at for at in own if first <= at <= last] for name, own in every.items()}

        def frames(name: str, mounted: TrueMotion, place: int) -> Any:
            camera = parts.cameras[name]
            return _see(self._args, self.world, camera, mounted, stamps[name], place)

        with BagWriter(folder) as bag:
            bag.write(TF_STATIC, make_mounts(parts), first)
            images = simulate_rig(parts, motion, frames)
            total = sum(map(len, stamps.values()))
            for image in tqdm(images, "simulate", total, unit="image", disable=None):
                write_rig_frame(bag, parts, motion, image, self._keypoints(image.frame))
        return {**node_parameters(parts), "base_frame": RIG_FRAME}

    def print_result(self) -> dict[str, object]:
        """Say what was written, and what comes next."""
        args, counts, world, out = self._args, self.counts, self.world, str(self._args.out)
        lasted, count = (self.stamps[-1] - self.stamps[0]) * 1e-9, len(self.stamps)
        figures: dict[str, object] = {"recording": out, "images": count}
        said = f"{out}: {count} {'images' if args.images else 'frames'} in {lasted:.1f} s"
        following = list[str]()
        if counts:
            figures["points_per_image"] = mean = float(np.mean(counts))
            said += f", {mean:.0f} points each"
            following = ["replay", out, "--params", f"{out}/{PARAMETERS}", "--out", f"{out}_poses"]
            following += ["--map", f"{out}/{MAP}"] if args.keypoints else []
        elif isinstance(world, Scene) and world.marker_map is not None:
            figures["markers"] = count = len(world.marker_map.markers)
            said += f", {count} markers on the walls"
            following = ["detect", out, "--map", f"{out}/{MARKER_MAP}", "--out", f"{out}_markers"]
        print(said)
        if following:
            print(f"next: {typed(*following)}")
        return figures
