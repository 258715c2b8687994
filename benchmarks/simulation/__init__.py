# Copyright 2026 rs_localizer contributors
# SPDX-License-Identifier: Apache-2.0
"""Recordings beyond ``rs_localizer simulate``: with an IMU, vibration, keypoints, or a rig.

``python -m benchmarks.simulation shaken --imu --vibration 0.3 60`` takes the options of
``simulate``, too.
"""
