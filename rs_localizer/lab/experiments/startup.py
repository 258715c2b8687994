"""How long a new process takes until its first pose: with nothing compiled, and from the cache."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile

# Runs in a new interpreter: prints seconds until the first pose and until every kernel is there.
_SCRIPT = """
import time
start = time.perf_counter()
import json
import numpy as np
import rs_localizer as rsl
from rs_localizer.solvers import SOLVERS
K = np.array([[500.0, 0.0, 319.5], [0.0, 500.0, 239.5], [0.0, 0.0, 1.0]])
rsl.Localizer(rsl.Camera(width=640, height=480, K=K)).warm_up()
first = time.perf_counter() - start
rng = np.random.default_rng(0)
for name, solver in SOLVERS.items():
    n = solver.sample_size
    sample = rng.normal(size=(1, n, 3)), rng.normal(size=(1, n, 2)), rng.uniform(-0.5, 0.5, (1, n))
    for as_published in (False, True):
        rsl.solve_minimal(name, *sample, as_published=as_published)
print(json.dumps([first, time.perf_counter() - start]))
"""


def first_pose_and_all_kernels() -> tuple[tuple[float, float], tuple[float, float]]:
    """Seconds (import to first pose, import to all kernels): from nothing, then with the cache.

    Raises:
        OSError: a new interpreter could not import or run the package.
    """
    with tempfile.TemporaryDirectory() as cache:
        environment = dict(os.environ)
        environment["NUMBA_CACHE_DIR"] = cache
        environment["PYTHONPATH"] = os.pathsep.join(sys.path)
        return _measure(environment), _measure(environment)


def _measure(environment: dict[str, str]) -> tuple[float, float]:
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
    first, everything = json.loads(done.stdout)
    return float(first), float(everything)
