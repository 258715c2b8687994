# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Two cameras on one body, the second upside down: their shutters run against each other."""

import numpy as np
from moving_camera import HEIGHT, READOUT, WIDTH, K, Moving, matches, scene

import rs_localizer as rsl

camera = rsl.Camera(WIDTH, HEIGHT, K, readout_time=READOUT)
rig = rsl.Rig(
    {"up": camera, "down": camera},
    camera_from_rig={  # X_camera = R X_rig + t
        "up": (np.eye(3), [0.0, 0.0, 0.0]),
        "down": (np.diag([-1.0, -1.0, 1.0]), [0.0, 0.0, 0.0]),
    },
)
wall = scene(120) * [1.0, 1.0, 0.0] + [0.0, 0.0, 3.0]
seen = {
    "up": matches(Moving(), wall, 0.0, seed=1),
    "down": matches(Moving(from_body=(0.0, 0.0, np.pi)), wall, 0.0, seed=2),
}
alone = rsl.Localizer(camera).localize(*seen["up"])
both = rsl.Localizer(rig).localize(seen, stamps={"up": 0.0, "down": 0.0})  # of the first rows, s
for name, result, of in (("one camera", alone, camera), ("both", both, rig)):
    if not result:
        print(name, "no pose:", result)
        continue
    position = rsl.camera_state(result, of).position
    print(f"{name}: {1e3 * np.linalg.norm(position):.1f} mm off before a wall")
