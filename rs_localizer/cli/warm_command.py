# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""``rs_localizer warm``: compiles all kernels before somebody waits for them."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass

from rs_localizer.cli import WORKING, Compiling
from rs_localizer.cli.options import option
from rs_localizer.solvers.table import SOLVERS

if WORKING:
    from rs_localizer.config import NodeConfig
    from rs_localizer.core.simd import compiler
    from rs_localizer.core.simd.jit import cache_directory
    from rs_localizer.markers import detection
    from rs_localizer.pipeline.frames import FrameLocalizer

# Any that is known: with it, frames are tracked, too.
_READOUT_TIME = 0.03


@dataclass(frozen=True, kw_only=True)
class Options:
    solver: list[str] = option(
        "only what frames need with this one; may be repeated (default: all solvers)", "NAME", list,
        choices=list(SOLVERS),
    )  # fmt: skip


def run(options: Options) -> dict[str, object]:
    """Compile, and say where the machine code is, and the seconds of each step.

    Raises:
        OSError: when it could not be kept there.
    """
    steps: dict[str, Callable[[], None]] = {"markers": detection.warm_up}
    seconds = dict[str, float]()
    for name in options.solver or SOLVERS:
        localizer = FrameLocalizer(NodeConfig(solver=name, readout_time=_READOUT_TIME))
        steps[f"solver {name}"] = localizer.warm_up_rest
    if not options.solver:
        steps["with an IMU"] = FrameLocalizer(NodeConfig(readout_time=_READOUT_TIME)).warm_up_imu
    with warnings.catch_warnings():
        warnings.filterwarnings("error", "cache of kernels .* at the next start", RuntimeWarning)
        for name, compiles in steps.items():
            started = time.monotonic()
            try:
                with compiler.told(Compiling()):
                    compiles()
            except RuntimeWarning as warning:
                raise OSError(str(warning)) from warning
            seconds[name] = time.monotonic() - started
            print(f"{name:24} {seconds[name]:6.1f} s", flush=True)
    print(f"kernels are in {cache_directory()}")
    return {"seconds": seconds, "kernels": str(cache_directory())}
