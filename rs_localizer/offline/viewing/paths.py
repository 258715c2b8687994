# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Names of what is shown, below which the viewer finds it."""

from __future__ import annotations

TIMELINE = "stamp"
"""Of the images, as ``header.stamp`` says it."""

MAP = "map"
LANDMARKS = "map/landmarks"
INLIERS = "map/inliers"
PATH = "map/path"
BODY = "map/body"
COVARIANCE = "map/covariance"
READOUT = "map/readout"
CAMERA = "map/camera"
IMAGE = "map/camera/image"
MATCHES = "map/camera/image/inliers"
RESIDUALS = "map/camera/image/residuals_x{}"
OTHERS = "map/camera/image/others"
REFUSED = "refused"

ANGULAR, LINEAR = "plots/angular_velocity", "plots/linear_velocity"
RESIDUAL, COUNTS, DEVIATION = "plots/residual", "plots/counts", "plots/deviation"
PLOTS = {
    ANGULAR: "angular velocity (rad/s)",
    LINEAR: "linear velocity (m/s)",
    RESIDUAL: "residual rms, model error (px)",
    COUNTS: "points, inliers with rolling and global shutter",
    DEVIATION: "standard deviation: position (mm), orientation (mrad)",
}
"""What is drawn over time, and its title."""
