# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""After warming up, calibrating and smoothing compile nothing any more."""

import os
import subprocess
import sys
from pathlib import Path

# In a process of its own: other tests compile, too.
_SCRIPT = """
import gc
import numpy as np
import projector
from numba.core.dispatcher import Dispatcher
from rs_localizer.core.camera import Camera
from rs_localizer.localizer import Localizer
from rs_localizer.tools.calibration import calibrate, likelihood
from rs_localizer.tools.adjust.observe import Observed, localize_each
from rs_localizer.tools.smoothing import smooth
from rs_localizer.tools.warm_up import warm_up

def compiled():
    return {(found.py_func.__module__, found.py_func.__name__, str(signature))
            for found in gc.get_objects() if isinstance(found, Dispatcher)
            for signature in found.signatures}

Localizer(Camera(width=640, height=480, K=projector.K, readout_time=0.03)).warm_up()
warm_up()
before = compiled()
camera = Camera(width=projector.WIDTH, height=projector.HEIGHT, K=projector.K, readout_time=0.03,
                D=np.array([0.01, -0.02, 0.003, -0.001]), distortion_model="equidistant")
rng = np.random.default_rng(0)
motion = projector.Motion.random(rng)
frames = projector.record(rng, motion, projector.room(rng, 300), readout=0.03, seconds=0.75)
images = [Observed(round(1e9 * f.stamp) + 10**9, f.points, f.pixels) for f in frames]
likelihood(camera, calibrate(camera, images), 1)
posed = [pair for pair in zip(images, localize_each(camera, images)) if pair[1]]
smoothed = smooth(camera, *map(list, zip(*posed)))
smoothed.sample(np.array([image.stamp_ns for image in images]))
assert any(module.endswith("adjust.spline_kernels") for module, _, _ in before)
print(sorted(compiled() - before))
"""


def test_calibrating_and_smoothing_compile_nothing_any_more():
    paths = [*filter(None, sys.path), str(Path(__file__).parent)]
    found = subprocess.run(
        [sys.executable, "-c", _SCRIPT],
        env=os.environ | {"PYTHONPATH": os.pathsep.join(paths)},
        capture_output=True, text=True, check=False, timeout=300,
    )  # fmt: skip
    assert found.returncode == 0, found.stderr
    assert found.stdout.strip() == "[]"
