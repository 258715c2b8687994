# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Where the time of a frame goes: ``python -m benchmarks.profiling``.

200 points, half of them outliers, 10 degrees and 0.1 m per readout, default settings.
"""

from __future__ import annotations

import argparse
import cProfile
import pstats

from benchmarks.experiments.trials import Setting, camera
from benchmarks.experiments.views import synthetic_views
from rs_localizer.localizer import Localizer


def main(arguments: list[str] | None = None) -> None:
    """Profile the localizer on simulated frames and print the costliest functions."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.profiling", description=__doc__.splitlines()[0]
    )
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--points", type=int, default=200)
    parser.add_argument("--outliers", type=float, default=0.5, metavar="SHARE")
    parser.add_argument("--angular", type=float, default=10.0, metavar="DEG", help="per readout")
    parser.add_argument("--linear", type=float, default=0.1, metavar="M", help="per readout")
    parser.add_argument("--lines", type=int, default=20)
    options = parser.parse_args(arguments)
    setting = Setting(
        angular=options.angular, linear=options.linear, noise=1.0, points=options.points
    )
    views = list(synthetic_views(options.frames, 0, setting, options.outliers))
    localizer = Localizer(camera())
    localizer.warm_up()
    profile = cProfile.Profile()
    profile.enable()
    for view in views:
        localizer.localize(view.points, view.pixels)
    profile.disable()
    pstats.Stats(profile).strip_dirs().sort_stats("tottime").print_stats(options.lines)


if __name__ == "__main__":
    main()
