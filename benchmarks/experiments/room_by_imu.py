# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Metres of a map by an IMU alone, in a room without markers:

    python -m benchmarks.experiments.room_by_imu --start 28 14

The rendered room of ``mapped_room``, mapped from 11.8 s of a recorded hand (TUM VI, room5) by its
pictures; then simulated IMUs along the same motion, each with a bias of 0.3 m/s^2, a lever arm of
4 cm that is not told, and stamps off by up to 20 ms: errors of scale and gravity, by the truth, and
the deviations that are told of them.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation
from tqdm import tqdm

from benchmarks.data import HAND_MOTION
from rs_localizer.cli import integer, number
from rs_localizer.core.arrays import Array
from rs_localizer.evaluation.cube_clip import CAMERA, SENSOR
from rs_localizer.evaluation.room_mapping import Piece, Room
from rs_localizer.io.trajectories import read_tum
from rs_localizer.mapping.anchors import Anchors
from rs_localizer.mapping.build import Given, Workshop, build_map
from rs_localizer.mapping.colmap import Effort
from rs_localizer.mapping.gauge import through
from rs_localizer.mapping.inertial_metres import inertial_metres
from rs_localizer.mapping.refine import RefinedMap
from rs_localizer.simulation.imu import Lever, simulate_imu
from rs_localizer.simulation.settings import ImuSettings
from rs_localizer.simulation.true_motion import TrueMotion
from rs_localizer.trajectory.imu import ImuRecording

_SECONDS, _RATE, _KEYPOINTS = 11.8, 15.0, 1000
_BIAS, _MOST_OFFSET = 0.3, 0.02  # m/s^2, s
_AROUND_NS = 10**9


class Weighed(NamedTuple):
    """What an IMU says of a map, beside the truth."""

    scale_error: float  # share
    scale_deviation: float
    gravity_error: float  # deg
    gravity_deviation: float
    offset_error: float  # s
    offset_deviation: float

    def told(self) -> str:
        return (
            f"{100 * self.scale_error:+7.2f} +- {100 * self.scale_deviation:.2f} %"
            f"{self.gravity_error:9.3f} +- {self.gravity_deviation:.3f} deg"
            f"{1e3 * self.offset_error:+8.2f} +- {1e3 * self.offset_deviation:.2f} ms"
        )


def weighed(motion: TrueMotion, refined: RefinedMap, seed: int) -> Weighed:
    """One IMU that went along."""
    rng = np.random.default_rng(seed)
    offset = float(rng.uniform(-_MOST_OFFSET, _MOST_OFFSET))
    settings = ImuSettings(accelerometer_bias=_BIAS, time_offset=offset)
    track = simulate_imu(motion, settings, Lever(), rng)
    ends = refined.start_ns + np.round(1e9 * refined.times[[0, -1]]).astype(np.int64)
    near = (track.stamps_ns > ends[0] - _AROUND_NS) & (track.stamps_ns < ends[1] + _AROUND_NS)
    found = inertial_metres(
        refined,
        ImuRecording(
            track.stamps_ns[near],
            track.angular_velocities[near],
            specific_forces=track.specific_forces[near],
        ),
    )
    states = refined.spline.states(refined.times)
    true = motion.state(refined.start_ns, refined.times)
    scale = through(states.positions, true.positions).scale
    turns = Rotation.from_matrix(true.rotations) * Rotation.from_matrix(states.rotations).inv()
    down = turns.mean().apply(found.metric.gravity)
    return Weighed(
        found.metric.scale / scale - 1.0,
        found.share,
        float(np.degrees(np.arctan2(np.hypot(down[0], down[1]), -down[2]))),
        float(np.degrees(found.metric.gravity_deviation)),
        found.mount.mount.delay - offset,
        found.mount.delay_deviation,
    )


def table(motion: TrueMotion, refined: RefinedMap, imus: int) -> Iterator[str]:
    """A line of each IMU, and what all together say."""
    yield f"{'IMU':>4}{'scale':>18}{'gravity':>23}{'offset of stamps':>22}"
    rows = []
    for seed in range(imus):
        rows.append(weighed(motion, refined, seed))
        yield f"{seed:4}{rows[-1].told()}"
    errors = np.array(rows)
    yield (
        f"rms of {imus}: scale {100 * _rms(errors[:, 0]):.2f} %, gravity {_rms(errors[:, 2]):.3f} "
        f"deg, offset {1e3 * _rms(errors[:, 4]):.2f} ms"
    )


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def main(arguments: list[str] | None = None) -> int:
    """Print a table for each start."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.experiments.room_by_imu",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument(
        "--start", type=number(0.0), nargs="+", default=[28.0], metavar="S", help="of the walks"
    )
    parser.add_argument("--imus", type=integer(1), default=6, metavar="N", help="of each walk")
    options = parser.parse_args(arguments)
    room = Room(read_tum(HAND_MOTION), CAMERA, SENSOR, _KEYPOINTS)
    for start in options.start:
        sys.stdout.write(f"walk from {start:g} s\n")
        for line in table(room.motion, _mapped(room, start), options.imus):
            sys.stdout.write(f"{line}\n")
            sys.stdout.flush()
    return 0


def _mapped(room: Room, start: float) -> RefinedMap:
    piece = Piece(start, _SECONDS, _RATE)
    with TemporaryDirectory() as images, TemporaryDirectory() as folder:
        with tqdm(total=len(room.stamps(piece)), desc="look", disable=None) as bar:
            views = room.look(piece, Path(images), lambda: bar.update(1), markers=False)
        with tqdm(desc="map", disable=None) as bar:
            work = Workshop(Path(folder), Effort(), lambda name, total: nullcontext(bar.update))
            given = Given(views, room.camera, Anchors(), room.camera.readout_time)
            return build_map(given, work).refined


if __name__ == "__main__":
    sys.exit(main())
