# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""The first pose of a process, and how long it took.

With ``-W error::RuntimeWarning`` and a cache that cannot be written it fails if it compiles.
"""

from __future__ import annotations

import importlib
import time

import numpy as np

FOCAL, WIDTH, HEIGHT = 500.0, 640, 480


def main() -> None:
    """Import the package, see random points from the origin, and find the camera there."""
    begin, begin_work = time.perf_counter(), time.process_time()
    rsl = importlib.import_module("rs_localizer")
    centre = np.array([(WIDTH - 1) / 2, (HEIGHT - 1) / 2])
    matrix = np.array([[FOCAL, 0.0, centre[0]], [0.0, FOCAL, centre[1]], [0.0, 0.0, 1.0]])
    camera = rsl.Camera(width=WIDTH, height=HEIGHT, K=matrix, readout_time=0.03)
    localizer = rsl.Localizer(camera)
    rng = np.random.default_rng(0)
    pixels = rng.uniform([0, 0], [WIDTH - 1, HEIGHT - 1], (100, 2))
    depths = rng.uniform(2.0, 8.0, (100, 1))
    points = depths * np.hstack([(pixels - centre) / FOCAL, np.ones((100, 1))])
    found = localizer.localize(points, pixels + rng.normal(scale=0.3, size=pixels.shape))
    passed, work = time.perf_counter() - begin, time.process_time() - begin_work
    assert found, found
    assert np.linalg.norm(found.translation) < 0.1, found.translation
    localizer.warm_up()  # whatever else a frame may need
    print(f"  first pose {passed:.2f} s after the import began, {work:.2f} s of the processor")


if __name__ == "__main__":
    main()
