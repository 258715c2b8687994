# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the time of a frame goes: ``python -m benchmarks.profiling``.

The first condition of ``python -m benchmarks.frames times``: a moving camera, 200 points, half of
them outliers; default settings.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats

from benchmarks.frames.generated import generate
from benchmarks.frames.timed import CONDITIONS, localizer_of


def main() -> None:
    """Profile the localizer on simulated frames and print the costliest functions."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.profiling", description=__doc__)
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--lines", type=int, default=20)
    options = parser.parse_args()
    frames = list(generate(CONDITIONS[0], options.frames, 0))
    localizer = localizer_of(CONDITIONS[0])
    localizer.warm_up()
    with cProfile.Profile() as profile:
        for frame in frames:
            localizer.localize(frame.points, frame.pixels)
    pstats.Stats(profile).strip_dirs().sort_stats("tottime").print_stats(options.lines)


if __name__ == "__main__":
    main()
