# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``python -m benchmarks.simulation OUT``: a bag as of ``simulate``, of more sensors."""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.simulation.imu import ImuBagWriter, ImuSettings, Lever, shaken, simulate_imu
from benchmarks.simulation.keypoints import keypoint_rows, random_descriptors
from benchmarks.simulation.rig import (
    camera_stamps,
    make_mounts,
    rig_parameters,
    simulate_rig,
    write_rig_frame,
)
from rs_localizer.cli import simulate_command as simulate
from rs_localizer.cli.options import Parser, add_options, option, read
from rs_localizer.core.arrays import Array
from rs_localizer.io.bags import BagWriter, make_message
from rs_localizer.io.clouds import make_cloud
from rs_localizer.io.maps.files import write_npz
from rs_localizer.io.maps.landmarks import Map
from rs_localizer.io.recording import (
    CAMERA_FRAME,
    CAMERA_INFO_TOPIC,
    KEYPOINTS_TOPIC,
    MAP,
    MAP_FRAME,
    MARKER_MAP,
    PARAMETERS,
    make_camera_info,
)
from rs_localizer.io.rigs import read_camchain
from rs_localizer.io.topics import TF_STATIC
from rs_localizer.markers.map_files import write_marker_map
from rs_localizer.settings import write_parameters
from rs_localizer.tools.simulation.renderer import RenderedFrame
from rs_localizer.tools.simulation.simulated_frames import SimulatedFrame
from rs_localizer.tools.simulation.simulated_recording import write_simulated, write_truth
from rs_localizer.tools.simulation.simulated_settings import FrameSettings
from rs_localizer.tools.simulation.true_motion import TrueMotion
from rs_localizer.tools.simulation.walls import Scene

# Random numbers of their own: the frames are the same with and without them.
_IMU_STREAM, _VIBRATION_STREAM = 14, 60


@dataclass(frozen=True, kw_only=True)
class Options(simulate.Options):
    vibration: list[tuple[float, float]] = option(
        "add vibration by DEG about any axis; may be repeated", "DEG HZ",
        list, limits=(0.0, math.inf),
    )  # fmt: skip
    imu: bool = option("write an IMU, too, and its mounting on /tf_static", default=False)
    imu_offset: float = option("to add to its stamps to get the camera's time", "S", 0.0)
    keypoints: bool = option("pixels with binary descriptors, and their map", default=False)
    rig: Path | None = option("several cameras: Kalibr's camchain, with their shutters", "FILE")


class _Recorder:
    """Writes what cameras see of a world; keypoints in the place of correspondences, if wanted."""

    def __init__(self, args: Options) -> None:
        self.args = args
        motion = simulate.motion_of(args)
        self.motion: TrueMotion = shaken(
            motion, args.vibration, np.random.default_rng([args.seed, _VIBRATION_STREAM])
        )
        self._rng = np.random.default_rng(args.seed)
        self.world: Scene | Array = simulate.world_of(args, self.motion, self._rng)
        self._map: Map | None = None
        if args.keypoints:
            assert not isinstance(self.world, Scene)
            count = len(self.world)
            marks = random_descriptors(count, self._rng)
            self._map = Map(self.world, np.arange(count), marks, MAP_FRAME)

    def keypoints(self, frame: SimulatedFrame | RenderedFrame) -> NDArray[Any] | None:
        if self._map is None or not isinstance(frame, SimulatedFrame):
            return None
        return keypoint_rows(frame, self._map, self._rng)

    def one_camera(self) -> dict[str, Any]:
        """Write the bag; the parameters of its camera."""
        args, motion, camera = self.args, self.motion, simulate.camera_of(self.args)
        stamps = simulate.stamps_of(args, camera, motion)
        with self._bag(camera.readout_time) as bag:
            for frame in simulate.see(args, self.world, camera, motion, stamps):
                rows = self.keypoints(frame)
                if rows is None:
                    write_simulated(bag, camera, frame)
                    continue
                stamp_ns = frame.stamp_ns
                bag.write(CAMERA_INFO_TOPIC, make_camera_info(camera, stamp_ns), stamp_ns)
                cloud = make_cloud(make_message, stamp_ns, CAMERA_FRAME, rows)
                bag.write(KEYPOINTS_TOPIC, cloud, stamp_ns)
                write_truth(bag, stamp_ns, frame.first_row)
                if frame.middle_ns != stamp_ns:
                    write_truth(bag, frame.middle_ns, frame.middle_row)
        direction = str(camera.scan_direction)
        return {"readout_time": camera.readout_time, "scan_direction": direction}

    def _bag(self, readout_time: float) -> BagWriter:
        if not self.args.imu:
            return BagWriter(self.args.out)
        lever, settings = Lever(), ImuSettings(time_offset=self.args.imu_offset)
        rng = np.random.default_rng([self.args.seed, _IMU_STREAM])
        track = simulate_imu(self.motion, settings, lever, rng)
        return ImuBagWriter(self.args.out, readout_time, track, settings, lever)

    def rig(self, chain: Path) -> dict[str, Any]:
        """Write the bag of several cameras; their parameters."""
        args, motion, parts = self.args, self.motion, read_camchain(chain)
        some = simulate.stamps_of(args, next(iter(parts.cameras.values())), motion)
        rate = FrameSettings().rate
        stamps = {
            name: [stamp for stamp in every if some[0] <= stamp <= some[-1]]
            for name, every in camera_stamps(parts, motion, rate, args.seed).items()
        }

        def see(name: str, mounted: TrueMotion, place: int) -> Any:
            camera = parts.cameras[name]
            return simulate.see(args, self.world, camera, mounted, stamps[name], place)

        with BagWriter(args.out) as bag:
            bag.write(TF_STATIC, make_mounts(parts), some[0])
            for image in simulate_rig(parts, motion, see):
                write_rig_frame(bag, parts, motion, image, self.keypoints(image.frame))
        return rig_parameters(parts)

    def write(self) -> None:
        args = self.args
        parameters = self.one_camera() if args.rig is None else self.rig(args.rig)
        write_parameters(args.out / PARAMETERS, parameters)
        if isinstance(self.world, Scene) and self.world.marker_map is not None:
            write_marker_map(args.out / MARKER_MAP, self.world.marker_map)
        if self._map is not None:
            write_npz(args.out / MAP, self._map)


def record(*words: object) -> None:
    """Write the recording that the words of a command line order."""
    parser = Parser(prog="python -m benchmarks.simulation")
    add_options(parser, Options)
    _Recorder(read(Options, parser.parse_args([str(word) for word in words]))).write()


if __name__ == "__main__":
    record(*sys.argv[1:])
