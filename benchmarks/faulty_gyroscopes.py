# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A gyroscope that is wrong beside a tracker: it is never worse than none, and what it has is said.

python -m benchmarks.faulty_gyroscopes

The independent simulator's hand before two scenes: points at all depths, and a wall. The gyroscope
is too fast, turned on its mount, late, its stamps step, or its range ends. Errors are medians of
the frames behind the first five, beside those of the camera alone on the same frames.
"""

import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks import command
from benchmarks.aided import Recorded, believed, record
from benchmarks.experiments.results import Table
from benchmarks.frames.judged import REGION
from benchmarks.independent.cameras import Camera
from benchmarks.independent.gyroscopes import Imu
from benchmarks.independent.motions import hand
from benchmarks.independent.rotations import Array, logarithm
from benchmarks.independent.scenes import Rich, Scene, Wall
from rs_localizer.core.reasons import Unused
from rs_localizer.core.types import Estimate
from rs_localizer.inertial.samples import SampleBuffer
from rs_localizer.localizer import Localizer
from rs_localizer.tracking import Tracker

SCENES: dict[str, Scene] = {"room": Rich(), "wall": Wall()}
_AXIS = np.array([0.48, 0.6, 0.64])


def _mount(degrees: float) -> tuple[float, float, float]:
    x, y, z = (math.radians(degrees) * _AXIS).tolist()
    return x, y, z


FAULTS: dict[str, Imu] = {
    "right": Imu(),
    **{f"scale {percent} %": Imu(scale=1.0 + 0.01 * percent) for percent in (1, 2, 5, 10, 20)},
    **{f"mount {degrees} deg": Imu(mount=_mount(degrees)) for degrees in (1, 2, 5, 10)},
    **{f"late {ms} ms": Imu(offset=-1e-3 * ms) for ms in (5, 20, 40)},
    "step 15 ms": Imu(step=0.015),
    "saturated": Imu(limit=0.5),
    "half as fast": Imu(scale=0.5),
    "still": Imu(scale=0.0, bias=0.0, noise=0.0),
    "radians as degrees": Imu(scale=180.0 / math.pi),
    "degrees as radians": Imu(scale=math.pi / 180.0),
    "mount 20 deg": Imu(mount=_mount(20)),
    "mount 30 deg": Imu(mount=_mount(30)),
    "sign of all": Imu(axes=(-1, -2, -3)),
    "sign of y": Imu(axes=(1, -2, 3)),
    "turned about z": Imu(axes=(2, -1, 3)),
    "x and y swapped": Imu(axes=(2, 1, 3)),
    "camera_link": Imu(axes=(3, -1, -2)),
}
_NOISE = 1.0  # px
_BEGIN = 5  # frames
_LENGTH = 60  # frames of a recording
_BEFORE_NS = 600_000_000
_LATEST_NS = 60_000_000  # stamps that are early or late by no more than this


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """What became of the frames of some recordings."""

    orientation: Array  # (n,) deg off at the middle row; NaN: not localized
    rate: Array  # (n,) deg/s off there
    inside: Array  # (n,) whether the pose lies in its region of 95 %
    used: float  # share of frames with the gyroscope
    said: str  # why it was not, or what it has; of the last frame that says so


def followed(recorded: Recorded, with_imu: bool = True) -> Found:
    """Track the frames of each recording with the gyroscope's readings, or the camera alone."""
    frames, rows, used, said = recorded.frames, [], 0, ""
    half_ns = round(0.5e9 * frames.camera.readout_time)
    for frame in range(len(frames)):
        middle_ns = frames.middle_ns(frame)
        if frames.place[frame] == 0:
            aid = recorded.aid() if with_imu else None
            tracker, buffer = Tracker(Localizer(believed(frames.camera)), aid), SampleBuffer()
            every, heard = recorded.samples[int(frames.recording[frame])], 0
        samples = None
        if with_imu:
            until = int(np.searchsorted(every.times_ns, middle_ns + _LATEST_NS))
            for k in range(heard, until):
                x, y, z = every.angular_velocity[k].tolist()
                buffer.add(int(every.times_ns[k]), "camera", (x, y, z))
            heard = until
            first_ns, last_ns = middle_ns - half_ns, middle_ns + half_ns
            since_ns, until_ns = middle_ns - _BEFORE_NS, middle_ns + _LATEST_NS
            found = buffer.between(first_ns, last_ns, since_ns, until_ns)
            if isinstance(found, Unused):
                said = found.reason.removeprefix("imu_")
            else:
                samples = found
        result = tracker.localize(middle_ns, *frames.seen(frame, _NOISE), readings=samples)
        if samples is not None and tracker.aid is not None:
            status = tracker.aid.status
            used += status.unused is None
            said = status.oddity or said
        if frames.place[frame] >= _BEGIN:
            rows.append(_errors(recorded, frame, result if result else None))
    orientation, rate, inside = np.array(rows).T
    return Found(orientation, rate, inside, used / len(frames), said)


def _errors(recorded: Recorded, frame: int, found: Estimate | None) -> tuple[float, float, float]:
    if found is None:
        return math.nan, math.nan, math.nan
    true, readout = recorded.frames.middle, recorded.frames.camera.readout_time
    # A step turns the camera in its own axes: exp(-[turn]x) R.
    turn = logarithm(true.rotation[frame].T @ found.rotation.T)
    move = found.rotation @ (found.position - true.position[frame])
    off = np.concatenate([turn, move])
    squared = off @ np.linalg.solve(found.covariance[:6, :6], off)
    rate = found.angular_velocity / readout - true.angular[frame]
    degrees = np.degrees([np.linalg.norm(turn), np.linalg.norm(rate)])
    return float(degrees[0]), float(degrees[1]), float(squared < REGION)


def table(faults: Sequence[str], recordings: int, seed: int) -> Table:
    """One row a fault: both scenes, beside the camera alone."""
    alone: dict[str, Found] = {}
    rows = []
    for fault in ("", *faults):
        row, used, said = [fault or "alone (deg, deg/s)"], [], ""
        for name, scene in SCENES.items():
            size, imu = (recordings, _LENGTH), FAULTS.get(fault)
            one = followed(record(Camera(), hand, scene, size, seed, imu), bool(fault))
            own = alone.setdefault(name, one)
            off, rate = np.nanmedian(one.orientation), np.nanmedian(one.rate)
            figures = f"{off:.3f}, {rate:.1f}"
            if fault:
                off, rate = off / np.nanmedian(own.orientation), rate / np.nanmedian(own.rate)
                figures = f"{off:.2f}, {rate:.2f}"
                used.append(f"{100.0 * one.used:.0f}")
            row += [figures, f"{100.0 * np.nanmean(one.inside):.0f}"]
            said = one.said or said
        rows.append([*row, ", ".join(used), said])
    heads = [head for name in SCENES for head in (name, "inside")]
    return Table(("", *heads, "used", "says"), rows)


def main(argv: Sequence[str] | None = None) -> int:
    parser = command(".faulty_gyroscopes", __doc__)
    parser.add_argument("--recordings", type=int, default=2, help="of 60 frames; %(default)s")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("faults", nargs="*", help=", ".join(FAULTS).replace("%", "%%"))
    args = parser.parse_args(argv)
    print(table(args.faults or list(FAULTS), args.recordings, args.seed).text())
    return 0


if __name__ == "__main__":
    sys.exit(main())
