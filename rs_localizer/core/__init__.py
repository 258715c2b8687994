# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Geometry: rotations, camera, shutter and state; imports NumPy and OpenCV, never ROS."""
