# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""How long a new process takes until its first pose: with nothing compiled, and from the cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from dataclasses import dataclass

# Runs in a new interpreter: seconds until the first pose and until every kernel is there, by the
# clock and of the processor.
_SCRIPT = """
import time
start = time.perf_counter()
start_of_work = time.process_time()
import json
import numpy as np
import rs_localizer as rsl
from rs_localizer.solvers.table import SOLVERS, find_solver

def passed():
    return time.perf_counter() - start, time.process_time() - start_of_work

K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
rsl.Localizer(rsl.Camera(width=640, height=480, K=K)).warm_up()
first = passed()
rng = np.random.default_rng(0)
for name in SOLVERS:
    n = find_solver(name).sample_size
    sample = rng.normal(size=(1, n, 3)), rng.normal(size=(1, n, 2)), rng.uniform(-0.5, 0.5, (1, n))
    for as_published in (False, True):
        rsl.solve_minimal(name, *sample, as_published=as_published)
print(json.dumps([*first, *passed()]))
"""


@dataclass(frozen=True, slots=True)
class Startup:
    """Seconds since the import. Work: of the processor, which other processes do not lengthen."""

    first_pose: float
    first_pose_work: float
    all_kernels: float
    all_kernels_work: float


def cold_and_warm() -> tuple[Startup, Startup]:
    """A process that finds nothing compiled, and one that finds everything in the cache.

    Raises:
        OSError: a new interpreter could not import or run the package.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ)
        environment["NUMBA_CACHE_DIR"] = cache
        environment["PYTHONPATH"] = os.pathsep.join(sys.path)
        return _measure(environment), _measure(environment)


def _measure(environment: dict[str, str]) -> Startup:
    done = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode != 0:
        last = done.stderr.strip().splitlines()[-1:] or ["no message"]
        raise OSError(f"a new interpreter could not run the package: {last[0]}")
    return Startup(*json.loads(done.stdout))
