# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""A video: each frame begins from the one before, which makes it faster and surer."""

import numpy as np
from moving_camera import HEIGHT, READOUT, WIDTH, K, Moving, matches, scene

import rs_localizer as rsl

camera = rsl.Camera(WIDTH, HEIGHT, K, readout_time=READOUT)
tracker = rsl.Tracker(rsl.Localizer(camera))
moving, points = Moving(turn=(0.1, 0.4, -0.1)), scene(150)
errors = []
for k in range(30):
    seconds = k / 30
    result = tracker.localize(round(1e9 * seconds), *matches(moving, points, seconds, seed=k))
    if not result:
        print(k, "no pose:", result)  # tracking continues where it can
        continue
    state = rsl.camera_state(result, camera)
    errors.append(np.linalg.norm(state.position - moving.position(seconds)))
    print(f"{k:2} {'tracked' if result.tracked else 'searched'} {state.position.round(3)}")
print(f"{len(errors)} of 30 frames, {1e3 * np.median(errors):.1f} mm off in the median")
