# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Measure the node under load: ``python -m benchmarks.load --rate 100 --minutes 10``.

Publisher, node and measuring subscriber are processes of their own on this machine. The exit code
is 0 if the figures meet the limits (on a quiet machine of two cores), else 1.
"""

import argparse
import sys

import numpy as np

from benchmarks.load.camera import simulated
from benchmarks.load.measuring import Result, steady
from rs_localizer.cli.options import number

_MOST_REPLACED = 0.001  # share of the frames
_MOST_P50, _MOST_P99 = 4.0, 12.0  # ms
_MOST_GROWTH = 5.0  # MB after the first minute
_ROUND = 8.0  # s of different frames where there is an IMU


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.load", description=__doc__)
    parser.add_argument("--rate", type=number(1.0), default=100.0, help="Hz of each camera")
    parser.add_argument("--minutes", type=number(0.05), default=1.0)
    parser.add_argument("--points", type=number(12, kind=int), default=500, help="of each frame")
    parser.add_argument("--outliers", type=number(0.0, 0.9), default=0.3, help="share of them")
    parser.add_argument(
        "--cameras", type=number(1, kind=int), default=1, help="each with its own node"
    )
    parser.add_argument(
        "--imu", type=number(100.0), default=0.0, metavar="HZ", help="of an IMU beside each camera"
    )
    args = parser.parse_args()
    # Frames and readings start over together.
    different = round(_ROUND * args.rate) if args.imu else 500
    frames = simulated(args.points, args.outliers, args.rate, different, args.imu)
    print(f"{args.points} points, {args.outliers:.0%} outliers", flush=True)
    results = steady(frames, args.cameras, round(60.0 * args.minutes * args.rate))
    print(f"{args.cameras} camera(s) at {args.rate:g} Hz for {args.minutes:g} min")
    met = [_report(index, result, args.rate) for index, result in enumerate(results)]
    return 0 if all(met) else 1


def _report(index: int, result: Result, rate: float) -> bool:
    """Print the figures of one camera; whether they meet the limits."""
    p50, p99, most = np.percentile(1e3 * result.latencies, (50, 99, 100)).tolist()
    replaced = result.replaced / result.frames
    memory = result.memory
    after_a_minute = float(memory[min(60, len(memory) - 1)])
    growth = float(memory[-1]) - after_a_minute
    spent = 1e3 * result.cpu * result.frames / (rate * max(result.answered, 1))
    print(
        f"camera {index}: {result.frames} frames, {result.answered} answered, "
        f"{result.replaced} replaced ({replaced:.3%}), {result.refused} refused, "
        f"{result.lost} lost{f', {result.imu} with the IMU' if result.imu else ''}\n"
        f"  latency p50 {p50:.2f} ms, p99 {p99:.2f} ms, most {most:.1f} ms\n"
        f"  memory {after_a_minute:.1f} MB after a minute, {growth:+.1f} MB at the end; "
        f"CPU {result.cpu:.0%} of a core, {spent:.2f} ms a pose"
    )
    return (
        result.lost == 0
        and replaced <= _MOST_REPLACED
        and p50 <= _MOST_P50
        and p99 <= _MOST_P99
        and growth <= _MOST_GROWTH
    )


if __name__ == "__main__":
    sys.exit(main())
