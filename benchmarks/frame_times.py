# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""What frames cost, from message to result, and what the slow ones do, without ROS:
``python -m benchmarks.frame_times``.

The frames of the load test (``benchmarks.load``), one after the other through the
pipeline of node and replay. CPU time of the thread counts, the least of some runs: what else the
machine does is hardly in it. Every run does the same, so that the slow frames of the first ones can
be profiled apart from the others in a last one.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.hand_held import CAMERA, HandHeld
from rs_localizer.config import NodeConfig
from rs_localizer.core.arrays import Array
from rs_localizer.io.camera_info import read_camera_info
from rs_localizer.io.imu import read_imu
from rs_localizer.io.recording import CAMERA_FRAME, make_camera_info, make_correspondences
from rs_localizer.pipeline.frames import FrameLocalizer

_PERCENTILES = (50, 90, 99, 100)
_SLOW = 1.5  # times the median


@dataclass(frozen=True, slots=True)
class Messages:
    """What a node would hear."""

    clouds: list[Any]
    readings: list[list[Any]]  # of an IMU, until after each frame


def messages(flight: HandHeld, imu_rate: float) -> Messages:
    """The messages of a flight; a rate (Hz) of 0: without an IMU."""
    frames = list(flight.simulate())
    clouds = [make_correspondences(f.stamp_ns, f.points, f.pixels, f.ids) for f in frames]
    readings: list[list[Any]] = [[] for _ in frames]
    # A frame is known when it has been read out, and the IMU's filter wants a little more.
    known = [frame.stamp_ns + round(2e9 * CAMERA.readout_time) for frame in frames]
    if imu_rate > 0.0:
        for stamp_ns, reading in flight.readings(imu_rate, CAMERA_FRAME):
            place = int(np.searchsorted(known, stamp_ns))
            if place < len(readings):
                readings[place].append(reading)
    return Messages(clouds, readings)


def run(given: Messages, profiles: list[cProfile.Profile] | None = None) -> tuple[Array, list[str]]:
    """Milliseconds (n,) of CPU time of each frame, and what was done.

    Args:
        profiles: of each frame, enabled while it is localized.
    """
    localizer = FrameLocalizer(NodeConfig(readout_time=CAMERA.readout_time))
    localizer.warm_up()
    localizer.calibrate(read_camera_info(make_camera_info(CAMERA, 0)))
    times, done = [], []
    for index, (cloud, readings) in enumerate(zip(given.clouds, given.readings, strict=True)):
        for reading in readings:
            localizer.imu.add(read_imu(reading))
        if profiles is not None:
            profiles[index].enable()
        start = time.thread_time()
        result = localizer.localize(cloud)
        times.append(1e3 * (time.thread_time() - start))
        if profiles is not None:
            profiles[index].disable()
        done.append(_said_of(result))
    return np.array(times), done


def _said_of(result: Any) -> str:
    if not result:
        return f"refused: {result.reason}"
    estimate = result.estimate
    words = ["tracked" if estimate.tracked else f"searched, {estimate.iterations} samples"]
    words.append(f"shaking of {len(estimate.shake)} polynomials")
    if estimate.turn is not None:
        words.append("with the IMU")
    return ", ".join(words)


def main(arguments: list[str] | None = None) -> None:
    """Time frames, and profile the slow ones apart from the others."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.frame_times", description="What frames cost."
    )
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--rate", type=float, default=100.0, metavar="HZ")
    parser.add_argument("--points", type=int, default=500)
    parser.add_argument("--outliers", type=float, default=0.3, metavar="SHARE")
    parser.add_argument("--imu", type=float, default=0.0, metavar="HZ", help="0: none")
    parser.add_argument("--runs", type=int, default=3, help="of which the least time counts")
    parser.add_argument("--lines", type=int, default=20, help="of each profile")
    parser.add_argument("--save", type=Path, metavar="FILE", help="the times, as .npy")
    options = parser.parse_args(arguments)
    flight = HandHeld(options.points, options.outliers, options.rate, options.frames)
    given = messages(flight, options.imu)
    runs = [run(given) for _ in range(options.runs)]
    times, done = np.min([times for times, _ in runs], axis=0), runs[0][1]
    figures = zip(_PERCENTILES, np.percentile(times, _PERCENTILES), strict=True)
    print("CPU time, ms: " + ", ".join(f"p{share} {value:.2f}" for share, value in figures))
    if options.save is not None:
        np.save(options.save, times)
    slow = times > _SLOW * np.median(times)
    print(f"{np.count_nonzero(slow)} frames take {_SLOW:g} times the median or more; the slowest:")
    for index in np.argsort(-times)[: options.lines]:
        print(f"  {index:5d} {times[index]:6.2f} ms, {done[index]}")
    if options.lines:
        ordinary_profile, slow_profile = cProfile.Profile(), cProfile.Profile()
        run(given, [slow_profile if here else ordinary_profile for here in slow])
        for name, profile in (("ordinary", ordinary_profile), ("slow", slow_profile)):
            print(f"\n{name} frames:")
            if profile.getstats():
                pstats.Stats(profile).strip_dirs().sort_stats("tottime").print_stats(options.lines)


if __name__ == "__main__":
    main()
