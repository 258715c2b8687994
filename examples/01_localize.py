# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Pose and velocity of one image, from points of a map and where the image shows them."""

import numpy as np
from moving_camera import HEIGHT, READOUT, WIDTH, K, Moving, matches, scene

import rs_localizer as rsl

moving = Moving()
points, pixels = matches(moving, scene(150), seconds=0.0)  # (n,3) m, (n,2) raw pixels

camera = rsl.Camera(WIDTH, HEIGHT, K, readout_time=READOUT, scan_direction="top_to_bottom")
result = rsl.Localizer(camera).localize(points, pixels)

if result:  # a Failure is false, and str() of it says why
    state = rsl.camera_state(result, camera)  # at the middle row, in the map, SI units
    # Of orientation and position, then of both velocities per readout, in the camera's axes.
    deviations = np.sqrt(np.diag(result.covariance))
    turning, moving_by = deviations[6:9] / READOUT, deviations[9:] / READOUT
    print("inliers", result.inliers.sum(), "of", len(points))
    print("position (m)", state.position.round(4), "+-", deviations[3:6].round(4))
    print("angular velocity (rad/s)", state.angular_velocity.round(3), "+-", turning.round(3))
    print("    true", moving.turn)
    print("velocity (m/s)", state.linear_velocity.round(3), "+-", moving_by.round(3))
    print("    true", moving.velocity)
    print("pose at the first row", *result.at(-0.5))
else:
    print("no pose:", result)
